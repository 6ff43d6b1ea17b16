"""What learning to act in the Maze leaves behind: Fig. 8, the table, behaviour, films."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.agents import CloningState
from jaxdyna.envs import Maze, MazeParams, MazeState
from jaxdyna.experiments import maze_train_tables as tables
from jaxdyna.experiments import plots, plots_frames, ratios, report
from jaxdyna.experiments.maze_train_options import SHARE_OF_ORACLE, WINDOW, Options
from jaxdyna.experiments.report import Results, markdown_table
from jaxdyna.experiments.run import Arm, ArmRun, first_run
from jaxdyna.experiments.train_cost import cost_of_parts, describe_cost
from jaxdyna.planners import solve_maze
from jaxdyna.rollout import first_states, rollout
from jaxdyna.statistics import bootstrap_interval, episodes_to_solve

PAPER = {"model_free": 700.0, "dyna": 250.0}
PAPER_RATIO = 0.36
STARTS, AT_ONCE = 1000, 100
MEASURES = {
    "collisions": "collisions an episode",
    "time_to_goal": "steps until the goal",
    "wrong_frames": "share of new frames predicted wrong",
    "wrong_rewards": "share of new rewards predicted wrong",
}
WRONG = ("wrong_frames", "wrong_rewards")
FILMED = (1, 50, 100, 200)
SMOOTHED = 10
FILM_STEPS = 100
Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class MazeReport:
    """The experiment's own part of a `jaxdyna.experiments.session.Session`."""

    options: Options

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """The final greedy policies on new starts: ``greedy_...`` ``[seeds, starts]``; and,
        but for ``--quick``, `cost_of_parts` of the first run.
        """
        env, agent = arm.dyna.env, arm.dyna.agent
        params, steps = arm.hparams.env, self.options.steps
        greedy = replace(arm.hparams.agent, epsilon_first=0.0, epsilon_last=0.0)
        policies = _without_replays(run.state.agent)

        def judge_some(state, key):
            def act(obs, key):
                return agent.act(state, obs, key, greedy)

            played = rollout(env, act, key, params, AT_ONCE, num_steps=steps)
            starts = first_states(env, jax.random.clone(key), params, AT_ONCE).env
            plans = jax.vmap(lambda start: solve_maze(env.env, start, params, steps))(starts)
            hit = (played.next_obs[..., -3] & played.next_obs[..., -1]).any((-1, -2))
            return {
                "greedy_return": played.reward.sum(-1),
                "greedy_oracle": plans.best_return,
                "greedy_collisions": hit.sum(-1),
            }

        def judge(state, key):
            keys = jax.random.split(key, STARTS // AT_ONCE)
            some = jax.lax.map(lambda key: judge_some(state, key), keys)
            return jax.tree.map(jnp.ravel, some)

        key, key_cost = jax.random.split(key)
        keys = jax.random.split(key, len(jax.tree.leaves(policies)[0]))
        judged = jax.jit(lambda *args: jax.lax.map(lambda pair: judge(*pair), args))(policies, keys)
        first = first_run(run.state)
        updates = (self.options.agent.updates, self.options.agent.fake_updates)
        kept = jax.tree.map(np.asarray, judged)
        if self.options.quick:
            return kept
        return kept | cost_of_parts(arm, updates, first, key_cost)

    def describe(self, curves: Curves) -> Results:
        """The final greedy policy in numbers, how wrong the model is, and what an episode costs."""
        share = curves["greedy_return"].mean(1) / curves["greedy_oracle"].mean(1)
        hits = curves["greedy_collisions"].mean(1)
        greedy = {"share": _summary(share), "collisions": _summary(hits)}
        begin = max(min(self.options.real_first, curves["real_return"].shape[1]) - 1, 0)
        spans = {"first_dreams": slice(begin, begin + SMOOTHED), "last": slice(-SMOOTHED, None)}
        model = {
            wrong: {when: float(curves[wrong][:, span].mean()) for when, span in spans.items()}
            for wrong in WRONG
            if wrong in curves
        }
        return {"greedy": greedy, "model": model, **describe_cost(curves)}

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``fig8.png``, ``solved.png``, ``behaviour.png``, ``film_ARM.gif``."""
        shares = {name: arm["real_return"] / arm["oracle_return"] for name, arm in curves.items()}
        rule = self.options.rule
        solved_at = {name: episodes_to_solve(rule.score(arm), rule) for name, arm in curves.items()}
        plots.learning_curves(
            out / "fig8.png",
            shares,
            SHARE_OF_ORACLE,
            solved_at,
            self.options.real_first,
            what="share of oracle",
            window=SMOOTHED,
        )
        begins = {name: at - WINDOW + 1 for name, at in solved_at.items()}
        known = {name: arm.shape[1] - WINDOW + 1 for name, arm in shares.items()}
        plots.solved_share(out / "solved.png", begins, known)
        drawn = {key: curves if key not in WRONG else _trained(curves) for key in MEASURES}
        said = {title: {name: arm[key] for name, arm in drawn[key].items() if key in arm}
                for key, title in MEASURES.items()}  # fmt: skip
        plots.behaviour(
            out / "behaviour.png", {title: arms for title, arms in said.items() if arms}, SMOOTHED
        )
        for name, arm in curves.items():
            columns = self._film(arm, solved_at[name][0])
            plots_frames.film(out / f"film_{name}.gif", columns, first_step=0)

    def _film(self, curves: Curves, solved_at: float) -> dict[str, np.ndarray]:
        """Real episodes of the first run at stages of its training, by title: the last is the one
        that it solved with, or else the last of all.
        """
        played = curves["film_action"].shape[1]
        end, first = int(min(solved_at, played)), self.options.real_first
        stages = sorted({number for number in (*FILMED, first, first + 10, end) if number <= end})
        titles = {number: f"episode {number}" for number in stages}
        titles[end] += " (solved)" if solved_at <= played else " (last, unsolved)"
        columns = {}
        for number, title in titles.items():
            placed, headed, done = (
                curves[f"film_{part}"][0, number - 1]
                for part in ("obstacles", "directions", "action")
            )
            frames = replay_frames(self.options, placed, headed, done)
            columns[title] = plots_frames.trails(frames[:FILM_STEPS])
        return columns

    def markdown(self, results: Results) -> str:
        """The report."""
        parts = [
            f"# The Maze, `{self.options.preset}` preset",
            f"`{results['command']}`",
            f"{report.runs(self.options.seeds)} of each arm. "
            f"{str(self.options.rule).capitalize()}. The oracle's return is the most that "
            "could be had from an episode's own start (value iteration). The rule is the same for "
            "all arms and counts every real episode. An unsolved run is never dropped: it "
            "leaves the mean undefined, of which only a lower bound (≥) is then known. "
            f"Held: solved, and still so good over the last "
            f"{report.HELD_EPISODES} episodes played.",
            markdown_table(*report.arm_table(results, PAPER, WINDOW)),
            *self._comparison(results),
            "![Fig. 8: share of the oracle's return against real episodes](fig8.png)",
            f"The figure's running mean is shorter than the rule's {WINDOW} episodes: a curve may "
            "be above the line before a run has solved.",
            "![share of the runs that have solved](solved.png)",
            "## What is learned, when",
            "An episode that never comes to the goal counts as one step more than it has. A frame "
            "is predicted wrong where any pixel is, one step ahead, and a reward by half a point; "
            "each real episode is judged before the model learns from it.",
            "![collisions, steps until the goal, wrong frames and rewards](behaviour.png)",
            *tables.model(results),
            f"Real episodes of the first run, their first {FILM_STEPS} steps. Blue is the agent, "
            "red an obstacle, green the goal; where they were before is fainter.",
            *(f"![real episodes of {name}](film_{name}.gif)" for name in results["arms"]),
            "## The final policy",
            f"Greedy, each run's on {STARTS:,} new starts, as it is after the last episode that "
            "the arm played: share of the oracle's return, and collisions an episode.",
            markdown_table(*tables.greedy(results)),
            "## How",
            tables.method(self.options),
            "## Time and memory",
            markdown_table(*tables.time(results)),
            *tables.cost(results),
        ]  # fmt: skip
        return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal, and the ratio under it."""
        title = f"Maze, {self.options.preset} preset, {report.runs(self.options.seeds)} an arm"
        report.print_table(console, title, *report.short_table(results, PAPER, WINDOW))
        for line in self._comparison(results):
            console.print(line.replace("**", ""))
        timing = results["timing"]
        console.print(f"{timing['total_s']:.0f} s in all")

    def _comparison(self, results: Results) -> list[str]:
        return ratios.comparisons(results, {"dyna": PAPER_RATIO})


def _without_replays(agent: Any) -> Any:
    """What an agent's state acts by."""
    if isinstance(agent, CloningState):
        nothing: Any = None
        return replace(agent, agent=_without_replays(agent.agent), shown=nothing)
    return replace(agent, real=None, fake=None)


def replay_frames(
    options: Options, obstacles: np.ndarray, directions: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """The frames of an episode, uint8 ``[T + 1, H, W, 3]``: nothing in the Maze is random once its
    obstacles are placed.

    Args:
        options: the experiment's.
        obstacles: cells at the start ``[n, 2]``.
        directions: ``[n]``.
        actions: ``[T]``.
    """
    maze = Maze(options.size, options.obstacles)

    def play(obstacles, directions, actions):
        agent, goal = jnp.array(maze.start_cell), jnp.array(maze.goal_cell)
        start = MazeState(agent, goal, obstacles, directions, jnp.int32(0))

        def step(state, action):
            state = maze.step(jax.random.key(0), state, action, MazeParams())[1]
            return state, maze.frame(state)

        frames = jax.lax.scan(step, start, actions)[1]
        return jnp.concatenate([maze.frame(start)[None], frames])

    as_int = (jnp.asarray(part, jnp.int32) for part in (obstacles, directions, actions))
    return np.asarray(jax.jit(play)(*as_int))


def _trained(curves: Mapping[str, Curves]) -> Mapping[str, Curves]:
    """Without the placebo, which is always wrong: its errors would dwarf all others."""
    return {name: arm for name, arm in curves.items() if name != "placebo"}


def _summary(values: np.ndarray) -> Results:
    return {
        "mean": float(values.mean()),
        "ci95": bootstrap_interval(values, lambda rows: rows.mean(-1)),
        "per_seed": values.tolist(),
    }

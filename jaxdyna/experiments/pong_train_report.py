"""What learning to play Pong leaves behind: curves, the table, the cause, films."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.experiments import plots, plots_frames, ratios, report
from jaxdyna.experiments.pong_equal import by_tens, cause_said, equal_episodes, mended
from jaxdyna.experiments.pong_games import games_said, scores
from jaxdyna.experiments.pong_method import method
from jaxdyna.experiments.pong_train_options import LEVEL, WINDOW, Options
from jaxdyna.experiments.pong_train_parts import (
    agent_config,
    busier,
    make_agent,
    world_of,
)
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.experiments.run import Arm, ArmRun, first_run
from jaxdyna.experiments.train_cost import cost_of_parts, cost_said, describe_cost
from jaxdyna.rollout import rollout
from jaxdyna.statistics import bootstrap_interval, episodes_to_solve

GREEDY_EPISODES = 20
FILM_STEPS = 150
SMOOTHED = 10
MAIN_ARMS = ("model_free", "dyna_l2", "dyna_adversarial", "dyna")
GAMES_SAID = {"jax": "the pure game", "ale": "the Atari 2600 game"}
MEASURES = {
    "won": "points won an episode",
    "lost": "points lost an episode",
    "wrong_frames": "share of new frames predicted wrong",
}
KEY = "Red is the opponent, green the own paddle, blue the ball."
Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class PongReport:
    """The experiment's own part of a `jaxdyna.experiments.session.Session`."""

    options: Options

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """The final greedy policies in new episodes: ``greedy_return`` ``[seeds, episodes]`` and
        ``film_greedy``, frames of one of the first run's; of the real game ``game_score`` ``[seeds,
        games]`` of whole games; and, but for ``--quick``, `cost_of_parts` of the first run.
        """
        env, agent = arm.dyna.env, arm.dyna.agent
        channels = world_of(self.options).frame_shape[-1]
        greedy = replace(arm.hparams.agent, epsilon_first=0.0, epsilon_last=0.0)
        policies = replace(run.state.agent, real=None, fake=None)

        def actor(state):
            return lambda obs, key: agent.act(state, obs, key, greedy)

        def play(state, key, episodes):
            act = actor(state)
            steps = self.options.steps
            return rollout(env, act, key, arm.hparams.env, episodes, num_steps=steps)

        def judge(pair):
            return play(pair[0], pair[1], GREEDY_EPISODES).reward.sum(-1)

        def filmed(state, key):
            newest = play(state, key, 1).next_obs[..., -channels:]
            return jnp.broadcast_to(newest, (*newest.shape[:-1], 3))

        def whole_games(policies, keys):
            def game(pair):
                return scores(env, actor(pair[0]), pair[1], env.default_params)

            return jax.lax.map(game, (policies, keys))

        key, key_cost, key_film, key_games = jax.random.split(key, 4)
        keys = jax.random.split(key, len(jax.tree.leaves(policies)[0]))
        returns = jax.jit(lambda *args: jax.lax.map(judge, args))(policies, keys)
        first = first_run(run.state)
        alone = replace(first.agent, real=None, fake=None)
        film = jax.jit(filmed)(alone, key_film)
        kept = {"greedy_return": np.asarray(returns), "film_greedy": np.asarray(film)}
        if self.options.game == "ale":
            game_keys = jax.random.split(key_games, len(keys))
            played = jax.jit(whole_games)(policies, game_keys)
            kept |= dict(zip(("game_score", "game_ended"), map(np.asarray, played), strict=True))
        if self.options.quick:
            return kept
        return kept | cost_of_parts(arm, self.updates_of(arm), first, key_cost)

    def updates_of(self, arm: Arm) -> tuple[int, int]:
        """After a real episode and after its dreams."""
        agent, game = agent_config(self.options), world_of(self.options)
        busy = busier(agent)
        if arm.dyna.agent is make_agent(game.frame_shape, game.num_actions, busy):
            return busy.updates, 0
        return agent.updates, agent.fake_updates

    def describe(self, curves: Curves) -> Results:
        """The final greedy policy in numbers, and what a real episode costs."""
        judged = {
            name: _mean_of_runs(curves[name].mean(1))
            for name in ("greedy_return", "game_score", "game_ended")
            if name in curves
        }
        steps = float(curves["real_length"].sum(1).mean())
        return judged | {
            "real_steps": steps,
            "by_tens": by_tens(curves["real_return"]),
            **describe_cost(curves),
        }

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``returns.png``, ``solved.png``, ``points.png``, ``film.gif``; ``cause.png`` where dreams
        are mended by the truth.
        """
        rule, options = self.options.rule, self.options
        solved_at = {name: episodes_to_solve(rule.score(arm), rule) for name, arm in curves.items()}
        shown = [name for name in curves if name in MAIN_ARMS] or list(curves)[:4]
        for path, names in {"returns.png": shown, "cause.png": mended(curves)}.items():
            returns = {name: curves[name]["real_return"] for name in names}
            if returns:
                plots.learning_curves(
                    out / path,
                    returns,
                    LEVEL,
                    solved_at,
                    options.real_first,
                    what="point difference",
                    window=SMOOTHED,
                )
        begins = {name: at - WINDOW + 1 for name, at in solved_at.items()}
        known = {
            name: max(arm["real_return"].shape[1] - WINDOW + 1, 1) for name, arm in curves.items()
        }
        plots.solved_share(out / "solved.png", begins, known)
        said = {title: {name: curves[name][key] for name in shown if key in curves[name]}
                for key, title in MEASURES.items()}  # fmt: skip
        plots.behaviour(
            out / "points.png", {title: arms for title, arms in said.items() if arms}, SMOOTHED
        )
        columns = {name: curves[name]["film_greedy"][0, :FILM_STEPS] for name in shown}
        plots_frames.film(out / "film.gif", columns)

    def markdown(self, results: Results) -> str:
        """The report."""
        options = self.options
        parts = [
            "# Pong: learning to play",
            f"`{results['command']}`",
            f"{options.seeds} runs of each arm. An episode is {options.steps} steps of "
            f"{options.frame_skip} frames of {GAMES_SAID[options.game]}, its return the points won "
            "less those lost, so that 0 is as many points as the opponent. "
            f"{str(options.rule).capitalize()}. "
            "The rule is the same for all arms and counts every real episode. An unsolved run is "
            "never dropped: it leaves the mean undefined, and only a lower bound (≥) is known.",
            markdown_table(*report.arm_table(results, {}, WINDOW)),
            *_comparison(results),
            *equal_episodes(results),
            "![point difference against real episodes](returns.png)",
            "![share of the runs that have solved](solved.png)",
            "![points won and lost, frames predicted wrong](points.png)",
            *cause_said(results),
            "## The final policy",
            f"Greedy, {GREEDY_EPISODES} new episodes a run: mean point difference, 95% interval.",
            markdown_table(*_greedy(results)),
            *games_said(results),
            KEY if options.frames == "objects" else "",
            "![the first run's final policies](film.gif)",
            "## How",
            method(options),
            "## Time",
            markdown_table(*_time(results)),
            *cost_said(results),
        ]  # fmt: skip
        return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal, and the ratios under it."""
        title = f"Pong, {self.options.preset} preset, {report.runs(self.options.seeds)} an arm"
        report.print_table(console, title, *report.short_table(results, {}, WINDOW))
        for line in _comparison(results):
            console.print(line.replace("**", ""))
        console.print(f"{results['timing']['total_s']:.0f} s in all")


def _comparison(results: Results) -> list[str]:
    """In episodes, the window included, and in the real steps before it, of the arms that solve."""
    arms = results["arms"]
    solving = {
        name: arm
        for name, arm in arms.items()
        if name == "model_free" or arm["real_steps_to_solve"]["mean"] is not None
    }
    steps = ratios.comparisons({"arms": solving}, {}, "real_steps_to_solve")
    return ratios.comparisons(results, {}) + steps


def _mean_of_runs(values: np.ndarray) -> Results:
    """Of one number a run."""
    return {
        "mean": float(values.mean()),
        "ci95": bootstrap_interval(values, lambda rows: rows.mean(-1)),
        "per_seed": values.tolist(),
    }


def _greedy(results: Results) -> tuple[list[str], list[list[str]]]:
    rows = []
    for name, arm in results["arms"].items():
        said = arm["greedy_return"]
        rows.append([name, f"{arm['episodes_played']}",
                     f"{said['mean']:.2f} ({interval(said['ci95'], 2)})"])  # fmt: skip
    return ["arm", "real episodes played", "point difference"], rows


def _time(results: Results) -> tuple[list[str], list[list[str]]]:
    timing = results["timing"]
    rows = [
        [name, f"{arm['compile_s']:.0f}", f"{arm['run_s']:.0f}"]
        for name, arm in timing["arms"].items()
    ]
    rows.append(["all, with judging and drawing", "", f"{timing['total_s']:.0f}"])
    cores = results["device"]["cpu_cores"]
    return [f"arm ({cores} cores)", "compiling (s)", "running (s)"], rows

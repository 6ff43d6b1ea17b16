"""What the CartPole experiment leaves behind: Figs. 5 and 6, the table, the model's accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.experiments import plots, report
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.experiments.run import Arm, ArmRun
from jaxdyna.models.evaluation import Predict, one_step, one_step_sums, open_loop
from jaxdyna.rollout import rollout
from jaxdyna.statistics import SolveRule, episodes_to_solve, r_squared

STATES = ("cart position", "cart velocity", "pole angle", "pole angular velocity")
OUTPUTS = ("position (m)", "velocity (m/s)", "angle (rad)", "ang. velocity", "reward", "p(end)")
PAPER = {"model_free": 650.0, "dyna": 400.0}
PAPER_RATIO = 0.62
HELD_OUT_EPISODES = 20
READING = """## How the paper is read

Fixed by the paper: the environment, REINFORCE with one hidden layer of 8, a dynamics network of two
hidden layers of 256 that predicts next state, reward and end (Eq. 1) under SGD 0.01, N = 100 real
episodes before the first dream.

Left open, and read thus: all real transitions are kept. Eq. 1 is a sum over a batch of 16; 60 such
updates follow each real episode. The model predicts the change of the state, scaled. A fake episode
starts where real ones did and ends at p > 0.1 (as in the authors' code) or after 200 steps. Two
policy updates on 8 fake episodes each follow every real one; a fake return is compared with the
mean of its batch at the same step. `experiments/cartpole_readings/report.md` in the repository
changes these details one at a time: it is the ablation behind this reading."""
Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class CartPoleReport:
    """The experiment's own part of a `jaxdyna.experiments.session.Session`."""

    preset: str
    rule: SolveRule
    real_first: int

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """Judges a trained model on episodes that it never saw, played by the final policy."""
        if arm.dyna.model is None:
            return {}
        predict = arm.dyna.model.predict
        seeds = run.metrics["real_return"].shape[0]
        judged = jax.jit(jax.vmap(lambda state, key: _judge(arm, predict, state, key)))(
            run.state, jax.random.split(jax.random.fold_in(key, 0), seeds)
        )
        first = jax.tree.map(lambda leaf: leaf[0], run.state)
        shown = jax.jit(lambda state, key: _example(arm, predict, state, key))(
            first, jax.random.fold_in(key, 1)
        )
        return jax.tree.map(
            np.asarray, {f"held_out_{name}": values for name, values in judged.items()} | shown
        )

    def describe(self, curves: Curves) -> Results:
        """One-step R² per state variable, of the next state and of its change."""
        if "held_out_count" not in curves:
            return {}
        held = {name.removeprefix("held_out_"): values for name, values in curves.items()}
        model = {}
        for kind in ("state", "change"):
            per_seed = r_squared(
                held["state_error"], held[f"{kind}_sum"], held[f"{kind}_square"], held["count"]
            )
            model[f"one_step_r2_{kind}"] = {
                name: {
                    "mean": float(values.mean()),
                    "min": float(values.min()),
                    "per_seed": values.tolist(),
                }
                for name, values in zip(STATES, per_seed.T, strict=True)
            }
        return {"model": model | {"held_out_transitions": int(held["count"].sum())}}

    def figures(self, out: Path, curves: Mapping[str, Curves]) -> None:
        """``fig5_ARM.png`` of each learned model and ``fig6.png``."""
        returns = {name: values["real_return"] for name, values in curves.items()}
        solved_at = {name: episodes_to_solve(values, self.rule) for name, values in returns.items()}
        plots.learning_curves(
            out / "fig6.png", returns, self.rule.threshold, solved_at, self.real_first
        )
        for name, values in curves.items():
            if "example_policy_truth" not in values:
                continue
            episodes = {
                title: _trimmed(values, who)
                for who, title in (
                    ("policy", "held-out episode of the trained policy"),
                    ("random", "held-out episode of a random policy, until it ends"),
                )
            }
            plots.prediction_figure(out / f"fig5_{name}.png", episodes, OUTPUTS)

    def markdown(self, results: Results) -> str:
        """The report."""
        header, rows = report.arm_table(results, PAPER)
        parts = [
            f"# CartPole, `{self.preset}` preset",
            f"`{results['command']}`",
            f"{_seeds(results)} runs of each arm. {str(self.rule).capitalize()}. The rule is the "
            "same for all arms and counts every real episode. An unsolved run is never dropped: it "
            "leaves the mean undefined, of which only a lower bound (≥) is then known.",
            markdown_table(header, rows),
            *self._comparison(results),
            "![Fig. 6: return against real episodes](fig6.png)",
            *([READING] if self.preset == "paper" else []),
            *self._models(results),
            *_timing(results),
        ]
        return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal, and the ratio under it."""
        header, rows = report.short_table(results, PAPER)
        title = f"CartPole, {self.preset} preset, {_seeds(results)} runs an arm"
        report.print_table(console, title, header, rows)
        for line in self._comparison(results):
            console.print(line.replace("**", ""))
        timing = results["timing"]
        console.print(
            f"{timing['total_s']:.1f} s in all: compiling {timing['compile_s']:.1f}, "
            f"running {timing['run_s']:.1f}"
        )

    def _comparison(self, results: Results) -> list[str]:
        lines = []
        for name, ratio in results["ratio_to_model_free"].items():
            if ratio["ratio"] is None:
                lines.append(
                    f"A run of {name} did not solve, so its ratio to model_free is unknown."
                )
                continue
            paper = f"; the paper's is {PAPER_RATIO}" if name == "dyna" else ""
            most = "at most " if ratio["bound"] else ""
            why = ", because model_free has unsolved runs" if ratio["bound"] else ""
            lines.append(
                f"{name} needs {most}**{ratio['ratio']:.2f}** of model_free's episodes{why} "
                f"(95% interval {interval(ratio['ci95'], 2)}{paper})."
            )
        return lines

    def _models(self, results: Results) -> list[str]:
        parts = []
        for name, arm in results["arms"].items():
            if "model" not in arm:
                continue
            rows = []
            for state in STATES:
                values = [
                    arm["model"][f"one_step_r2_{kind}"][state] for kind in ("state", "change")
                ]
                rows.append(
                    [state, *(f"{v[part]:.4f}" for v in values for part in ("mean", "min"))]
                )
            parts += [
                f"## The model of `{name}`",
                f"One-step R² on {HELD_OUT_EPISODES} new episodes of each run's final policy "
                f"({arm['model']['held_out_transitions']:,} transitions, none of them trained on). "
                "The next state is easy to explain, because it is close to the state before; the "
                "change of the state is the harder test.",
                markdown_table(
                    ["variable", "next state: mean", "worst seed", "change: mean", "worst seed"],
                    rows,
                ),
                f"![Fig. 5: predictions of the first seed's model](fig5_{name}.png)",
                "Fed with its own predictions the model leaves the true episode after some tens of "
                "steps: the recorded actions balance the real pole, not the slightly different one "
                "that is imagined. The policy that acts in a dream reacts to what it sees there.",
            ]
        return parts


def _judge(arm: Arm, predict: Predict, state: Any, key: jax.Array) -> dict[str, jax.Array]:
    key_play, key_judge = jax.random.split(key)
    real = _play(arm, state, key_play, HELD_OUT_EPISODES)
    return one_step_sums(predict)(state.model.params, real, key_judge)


def _example(arm: Arm, predict: Predict, state: Any, key: jax.Array) -> dict[str, jax.Array]:
    """Truth and predictions of one episode of the policy and one of a random policy."""
    arrays = {}
    for name, key_episode in zip(("policy", "random"), jax.random.split(key), strict=True):
        key_play, key_one, key_open = jax.random.split(key_episode, 3)
        real = _play(arm, state, key_play, 1, at_random=name == "random")
        params = state.model.params
        step = jax.tree.map(lambda leaf: leaf[0], one_step(predict, params, real, key_one))
        free = open_loop(predict, params, real.obs[0, 0], real.action[0], key_open)
        truth = (real.next_obs[0], real.reward[0], real.terminated[0])
        arrays[f"example_{name}_truth"] = _columns(*truth)
        arrays[f"example_{name}_one_step"] = _columns(step.next_obs, step.reward, step.terminated)
        arrays[f"example_{name}_open_loop"] = _columns(free.next_obs, free.reward, free.terminated)
        arrays[f"example_{name}_length"] = real.mask[0].sum()
    return arrays


def _play(arm: Arm, state: Any, key: jax.Array, episodes: int, at_random: bool = False):
    def act(obs, key):
        if at_random:
            return jax.random.randint(key, (), 0, arm.dyna.env.num_actions)
        return arm.dyna.agent.act(state.agent, obs, key, arm.hparams.agent)

    return rollout(
        arm.dyna.env, act, key, arm.hparams.env, episodes, num_steps=arm.config.num_steps
    )


def _columns(next_obs: jax.Array, reward: jax.Array, terminated: jax.Array) -> jax.Array:
    return jnp.concatenate([next_obs, reward[:, None], terminated[:, None]], axis=1)


def _trimmed(curves: Curves, who: str) -> dict[str, np.ndarray]:
    length = int(curves[f"example_{who}_length"])
    kinds = ("truth", "one_step", "open_loop")
    return {kind: curves[f"example_{who}_{kind}"][:length] for kind in kinds}


def _seeds(results: Results) -> int:
    return next(iter(results["arms"].values()))["episodes_to_solve"]["seeds"]


def _timing(results: Results) -> list[str]:
    timing = results["timing"]
    rows = [
        [name, f"{arm['compile_s']:.1f}", f"{arm['run_s']:.1f}"]
        for name, arm in timing["arms"].items()
    ]
    device = results["device"]
    return [
        "## Time",
        f"{timing['total_s']:.1f} s in all on {device['cpu_cores']} cores ({device['platform']}): "
        f"{timing['compile_s']:.1f} s compiling, {timing['run_s']:.1f} s running, the rest "
        "judging the models and drawing.",
        markdown_table(["arm", "compiling (s)", "running (s)"], rows),
    ]

"""What the CartPole experiment leaves behind: Figs. 5 and 6, the table, the model's accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cartpole_model, plots, ratios, report
from jaxdyna.experiments.cartpole_options import Options
from jaxdyna.experiments.report import Results, markdown_table
from jaxdyna.experiments.run import Arm, ArmRun
from jaxdyna.statistics import episodes_to_solve

PAPER = {"model_free": 650.0, "dyna": 400.0}
PAPER_RATIO = 0.62
Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class CartPoleReport:
    """The experiment's own part of a `jaxdyna.experiments.session.Session`."""

    options: Options

    @property
    def paper(self) -> dict[str, float]:
        """The paper's figures, where they are of this environment."""
        return PAPER if self.options.env_version == "v0" else {}

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """Judges a trained model on episodes that it never saw; the placebo's is none."""
        return cartpole_model.judge(arm, run, key) if arm.hparams.model_trains else {}

    def describe(self, curves: Curves) -> Results:
        """The model's accuracy, and what its dreams were like."""
        dreams = report.first_dreams(curves, self.options.real_first)
        return cartpole_model.describe(curves) | {"first_dreams": dreams}

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``fig5_ARM.png`` of each learned model and ``fig6.png``."""
        returns = {name: values["real_return"] for name, values in curves.items()}
        solved_at = {
            name: episodes_to_solve(values, self.options.rule) for name, values in returns.items()
        }
        plots.learning_curves(
            out / "fig6.png",
            returns,
            self.options.rule.threshold,
            solved_at,
            self.options.real_first,
        )
        first = {name: values - self.options.rule.window + 1 for name, values in solved_at.items()}
        plots.solved_share(out / "solved.png", first)
        for name, values in curves.items():
            if "example_policy_truth" not in values:
                continue
            episodes = {
                title: cartpole_model.trimmed(values, who)
                for who, title in (
                    ("policy", "held-out episode of the trained policy"),
                    ("random", "held-out episode of a random policy, until it ends"),
                )
            }
            plots.prediction_figure(out / f"fig5_{name}.png", episodes, cartpole_model.OUTPUTS)

    def markdown(self, results: Results) -> str:
        """The report."""
        header, rows = report.arm_table(results, self.paper)
        parts = [
            f"# CartPole, `{self.options.preset}` preset",
            f"`{results['command']}`",
            f"{report.runs(_seeds(results))} of each arm. {str(self.options.rule).capitalize()}. "
            "The rule is the same for all arms and counts every real episode. An unsolved run is "
            "never dropped: it leaves the mean undefined, of which only a lower bound (≥) is "
            "then known.",
            markdown_table(header, rows),
            *self._comparison(results),
            "![Fig. 6: return against real episodes](fig6.png)",
            "## The whole distribution",
            "`first_solved`, the number of the solving window's first episode, in quantiles over "
            "the runs. The window forgives a few falls at its start, so that the policy may be "
            "found only some episodes later:",
            markdown_table(*report.quantile_table(results, "first_solved")),
            "The first single episode at or above the threshold:",
            markdown_table(*report.quantile_table(results, "first_at_threshold")),
            "Held, in the first table: solved, and at or above the threshold on average over the "
            f"last {report.HELD_EPISODES} episodes played.",
            "![share of the runs that have solved](solved.png)",
            *reading(self.options),
            *self._models(results),
            *_timing(results),
        ]
        return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal, and the ratio under it."""
        header, rows = report.short_table(results, self.paper)
        title = f"CartPole, {self.options.preset} preset, {report.runs(_seeds(results))} an arm"
        report.print_table(console, title, header, rows)
        for line in self._comparison(results):
            console.print(line.replace("**", ""))
        timing = results["timing"]
        console.print(
            f"{timing['total_s']:.1f} s in all: compiling {timing['compile_s']:.1f}, "
            f"running {timing['run_s']:.1f}"
        )

    def _comparison(self, results: Results) -> list[str]:
        return ratios.comparison(results, {"dyna": PAPER_RATIO} if self.paper else {})

    def _models(self, results: Results) -> list[str]:
        parts = []
        for name, arm in results["arms"].items():
            if arm["first_dreams"]:
                parts += [_dreams(name, arm["first_dreams"])]
            if "model" in arm:
                parts += cartpole_model.markdown(name, arm)
        return parts


def reading(options: Options) -> list[str]:
    """The settings in words."""
    lines = [_policy_line(options), _model_line(options), _dreams_line(options)]
    lines += _planner_lines(options)
    if options.rest_when_safe:
        lines.append(
            "Rest: no model updates and no dreams after a real episode that did not fall, no "
            "further dreams after a batch of them in which nothing fell."
        )
    if options.dream_noise:
        lines.append(f"Noise of {options.dream_noise:g} standard deviations on predicted states.")
    if options.authors_bug:
        lines.append("The authors' slip is in place: the dreamed angle is overwritten.")
    note = (
        "`experiments/cartpole_readings/report.md` in the repository changes these details one at "
        "a time: it is the ablation behind this reading of the paper."
    )
    text = "\n".join(f"- {line}" for line in lines)
    return ["## Settings", text, *([note] if options.preset == "paper" else [])]


def _policy_line(options: Options) -> str:
    agent, hparams = options.agent, options.hparams.agent
    return (
        f"Policy: one action's log odds each from hidden layers of {agent.hidden}, "
        f"{agent.optimizer.__name__} at {hparams.learning_rate:g}, discount "
        f"{hparams.discount:g}, returns standardised `{agent.advantage.__name__}`."
    )


def _model_line(options: Options) -> str:
    model = options.model
    members = f"{model.ensemble} networks" if model.ensemble > 1 else "one network"
    loss = "a sum over the batch" if model.sum_loss else "a mean of the batch"
    target = "the change of the state" if model.delta else "the next state"
    scale = f"scaled by {model.spread:g} standard deviation(s)" if model.normalise else "not scaled"
    kept = f"the last {options.forget_every} episodes" if options.forget_every else "all episodes"
    share = (
        f", a share of {options.terminal_share:g} from transitions that ended an episode"
        if options.terminal_share is not None
        else ""
    )
    return (
        f"Model: {members} with hidden layers of {model.hidden}, {model.optimizer.__name__} at "
        f"{options.hparams.model.learning_rate:g}; Eq. 1 is {loss}; it predicts {target}, {scale}. "
        f"After every real episode {options.model_updates} updates on batches of "
        f"{options.model_batch} out of {kept}{share}."
    )


def _dreams_line(options: Options) -> str:
    hparams = options.hparams
    start = {
        "observed": "where real episodes did",
        "uniform": "uniformly in ±0.1",
        "branched": "from any real state",
    }[options.dream_start]
    unsure = (
        f", or the members disagree by more than {hparams.disagreement_threshold:g} standard "
        "deviations"
        if np.isfinite(hparams.disagreement_threshold)
        else ""
    )
    return (
        f"Dreams: after every real episode from number {options.real_first} on, "
        f"{options.dream_updates} policy updates on {options.dream_episodes} fake episodes each. A "
        f"fake "
        f"episode starts {start} and ends at p(end) > {hparams.termination_threshold:g}{unsure}, "
        f"or after {options.dream_steps or options.num_steps} steps. From then on a real "
        f"transition's weight is {hparams.real_weight:g} and a fake one's {hparams.fake_weight:g}."
    )


IMITATES = {
    "mpc_init": "goes on model-free",
    "mpc_init_dyna": "goes on with dreams like `dyna`",
    "mpc_clone": "stays as it then is",
}


def _planner_lines(options: Options) -> list[str]:
    mpc, mcts, lines = options.mpc, options.mcts, []
    if {"mpc", *IMITATES} & set(options.arms):
        lines.append(
            f"`mpc`: from real episode {options.real_first + 1} on decides by {mpc.candidates} "
            f"random sequences of {mpc.horizon} steps in the model (temperature "
            f"{mpc.temperature:g}); no dreams."
        )
    if "mcts" in options.arms:
        lines.append(
            f"`mcts`: likewise by a tree of {mcts.simulations} nodes (MuZero's search), random "
            f"episodes of {options.mcts_rollout} steps for the value of its leaves; no dreams."
        )
    for name, goes_on in IMITATES.items():
        if name in options.arms:
            lines.append(
                f"`{name}`: `mpc` plays {options.shown_episodes} episodes; the policy imitates "
                f"them ({options.cloning.updates} updates after each) and {goes_on}."
            )
    return lines


def _dreams(name: str, dreams: Results) -> str:
    said = (
        f"In the first {report.FIRST_DREAMS} episodes with dreams of `{name}` the median fake "
        f"episode lasts {dreams['fake_length']:.0f} steps for a return of "
        f"{report.whole(dreams['fake_return'])}, the "
        f"median real one {dreams['real_length']:.0f}."
    )
    return said if np.isfinite(dreams["fake_length"]) else f"`{name}` had no dreams."


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

"""What the paper leaves open on CartPole, one detail at a time: which reading gives its effect?

``python -m jaxdyna.experiments.cartpole_readings`` plays the ``dyna`` arm of the ``paper`` preset
with one detail changed in each row, beside the model-free arm under several learning rates.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna.agents.reinforce import over_batch, within_episode
from jaxdyna.experiments import cartpole_options as cartpole
from jaxdyna.experiments import cli, plots, report
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.report import Results, interval, markdown_table, number
from jaxdyna.experiments.run import Arm, ArmRun
from jaxdyna.experiments.session import Session
from jaxdyna.statistics import SolveRule, bootstrap_interval, episodes_to_solve

PROG = "python -m jaxdyna.experiments.cartpole_readings"
PRESET = "dyna (paper preset)"
Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class Options:
    """One detail of the paper preset changed at a time."""

    preset: str = "paper"
    """Only paper: the preset whose details are changed."""
    seeds: int = 10
    """Runs of every reading."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 600
    """Real episodes of a run at the most."""
    arms: tuple[str, ...] = ()
    """Names of the readings to play, as the table has them; all by default."""
    out: Path = Path("runs/cartpole-readings")
    """Folder for the results."""
    resume: bool = False
    """Go on with the run in that folder."""
    stop_after_solved: int | None = 0
    """Episodes a reading plays on once all its seeds have solved; None plays all of them."""

    def __post_init__(self) -> None:
        if self.preset != "paper":
            raise ValueError(f"--preset is {self.preset}: the readings are of the paper preset")
        cli.check_common(self)
        unknown = sorted(set(self.arms) - set(readings(self)))
        if unknown:
            there_are = "; ".join(readings(self))
            raise ValueError(f"--arms: there is no {'; '.join(unknown)}; there are: {there_are}")


def readings(options: Options) -> dict[str, Arm]:
    """Every reading by name, the preset itself first."""
    base = replace(
        cartpole.PAPER,
        seeds=options.seeds,
        episodes=options.episodes,
    )
    literal = replace(base.model, delta=False, normalise=False)

    def model(**changes: Any) -> cartpole.Options:
        return replace(base, model=replace(base.model, **changes))

    def agent(advantage: Any) -> cartpole.Options:
        return replace(base, agent=replace(base.agent, advantage=advantage))

    def threshold(value: float) -> cartpole.Options:
        return replace(base, hparams=replace(base.hparams, termination_threshold=value))

    variants = {
        PRESET: base,
        "returns standardised within an episode": agent(within_episode),
        "returns standardised over the batch": agent(over_batch),
        "2 updates on 1 fake episode each": replace(base, dream_episodes=1),
        "16 updates on 1 fake episode each": replace(base, dream_updates=16, dream_episodes=1),
        "4 fake episodes an update": replace(base, dream_episodes=4),
        "4 updates on dreams": replace(base, dream_updates=4),
        "targets are next states": model(delta=False),
        "scaled by 1 standard deviation, not 3": model(spread=1.0),
        "no normalisation": model(normalise=False),
        "no normalisation, next states": replace(base, model=literal),
        "no normalisation, next states, mean of the batch": replace(
            base, model=replace(literal, sum_loss=False)
        ),
        "Eq. 1 as a mean of the batch": model(sum_loss=False),
        "the same, scaled by 1, next states": model(sum_loss=False, spread=1.0, delta=False),
        "batch of 5": replace(base, model_batch=5),
        "LeCun initial weights": model(weight_variance=1.0),
        "20 model updates": replace(base, model_updates=20),
        "fake episode ends at p > 0.03": threshold(0.03),
        "fake episode ends at p > 0.5": threshold(0.5),
        "dreams start uniform ±0.1": replace(base, dream_start="uniform"),
        "replay emptied every 20 episodes": replace(base, forget_every=20),
        "authors' slip: angle overwritten": replace(base, authors_bug=True),
    }
    arms = {name: _without_diagnosis(variant) for name, variant in variants.items()}
    return arms | _controls(base)


def _controls(base: cartpole.Options) -> dict[str, Arm]:
    """The true environment in the model's place, and no model at several learning rates."""
    arms = {
        "true environment as the model": make_arms(base)["oracle"],
        "true environment, 2 updates on 1 fake episode each": make_arms(
            replace(base, dream_episodes=1)
        )["oracle"],
    }
    alone = make_arms(base)["model_free"]
    for rate in (0.005, 0.01, 0.015, 0.02):
        agent = replace(alone.hparams.agent, learning_rate=rate)
        hparams = replace(alone.hparams, agent=agent)
        arms[f"model-free, learning rate {rate:g}"] = alone._replace(hparams=hparams)
    return arms


def _without_diagnosis(options: cartpole.Options) -> Arm:
    """The ``dyna`` arm without the running judgement of its model, which no table here needs."""
    arm = make_arms(options)["dyna"]
    return arm._replace(dyna=arm.dyna._replace(diagnose=None))


@dataclass(frozen=True)
class ReadingsReport:
    """A row and a strip of dots for each reading."""

    rule: SolveRule
    episodes: int

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """Nothing beyond the curves."""
        return {}

    def describe(self, curves: Curves) -> Results:
        """What the first dreams were like."""
        return {"first_dreams": report.first_dreams(curves, cartpole.PAPER.real_first)}

    def figures(self, out: Path, curves: Mapping[str, Curves]) -> None:
        """``readings.png``."""
        solved_at = {
            name: episodes_to_solve(values["real_return"], self.rule)
            for name, values in curves.items()
        }
        title = "CartPole, paper preset with one detail changed"
        plots.solve_bars(out / "readings.png", solved_at, self.episodes, title)

    def markdown(self, results: Results) -> str:
        """The report."""
        return (
            "\n\n".join(
                [
                    "# Which reading of the paper gives its effect on CartPole?",
                    f"`{results['command']}`",
                    "Each row changes one detail of the `dyna` arm of the `paper` preset. "
                    f"{str(self.rule).capitalize()}. At most {self.episodes} episodes; a mean "
                    "with an unsolved run in it is shown as its lower bound (≥). The seeds are the "
                    "same in every row, so that the difference to the preset is paired (unsolved "
                    f"counted as {self.episodes + 1}). Fake and real return: medians over the "
                    "first 100 episodes with dreams.",
                    markdown_table(*_long_table(results)).rstrip(),
                    "![every seed of every reading](readings.png)",
                ]
            )
            + "\n"
        )

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal."""
        report.print_table(console, "Readings of the paper on CartPole", *_table(results))


def _table(results: Results) -> tuple[list[str], list[list[str]]]:
    header = ["reading", "episodes to solve", "95% interval", "median", "solved"]
    rows = []
    for name, arm in results["arms"].items():
        solve = arm["episodes_to_solve"]
        solved = f"{solve['solved']}/{solve['seeds']}"
        rows.append([name, number(solve), interval(solve["ci95"]), number(solve, "median"), solved])
    return header, rows


def _long_table(results: Results) -> tuple[list[str], list[list[str]]]:
    """With the difference to the preset, seed by seed, and the first dreams beside the truth."""
    header, rows = _table(results)
    limit = results["config"]["episodes"] + 1
    preset = _bounded(results["arms"].get(PRESET), limit)
    for row, arm in zip(rows, results["arms"].values(), strict=True):
        if preset is None or row[0] == PRESET:
            row.append("-")
        else:
            difference = _bounded(arm, limit) - preset
            ends = bootstrap_interval(difference, lambda values: values.mean(-1))
            row.append(f"{difference.mean():+.0f} ({interval(ends)})")
        dreams = arm["first_dreams"]
        row.append(f"{dreams['fake_return']:.0f} / {dreams['real_return']:.0f}" if dreams else "-")
    return [*header, "longer than the preset", "first dreams: fake / real return"], rows


def _bounded(arm: Results | None, limit: int) -> Any:
    if arm is None:
        return None
    values = arm["episodes_to_solve"]["per_seed"]
    return np.array([limit if value is None else value for value in values], float)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the readings from the command line; returns the exit code."""
    options = cli.parse({"paper": Options()}, argv, PROG)
    arms = readings(options)
    chosen = {name: arms[name] for name in options.arms or arms}
    rule = cartpole.PAPER.rule
    session = Session(
        experiment="cartpole_readings",
        prog=PROG,
        argv=sys.argv[1:] if argv is None else argv,
        options=options,
        out=options.out,
        rule=rule,
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=ReadingsReport(rule, options.episodes),
    )
    return session.run(chosen)


if __name__ == "__main__":
    sys.exit(main())

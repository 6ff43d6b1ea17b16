"""Grids of settings in which an arm is tuned, as rows of a study: as many for ``dyna`` as for the
baseline without a model, so that both get the same care (van Hasselt et al. 2019).
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

from jaxdyna.experiments.engine import Experiment, Overrides, Study
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.rows import ranking

Rows = dict[str, Overrides]
TARGETS = (1, 3)  #: rewards in a target
RATES = (3e-4, 1e-3)  #: a DQN's learning rates
SHARES = (0.5, 0.75)  #: of each batch that are dreamed


def baselines(
    agent: str, hparams: str, ratios: Sequence[float], between: int,
    said: Callable[[float], Overrides],
) -> Rows:  # fmt: skip
    """A DQN by itself: more updates a real step overfit what was seen first, unless the networks
    begin anew now and then (Nikishin et al. 2022; D'Oro et al. 2023).

    Args:
        agent: path of its configuration.
        hparams: path of its values.
        ratios: gradient steps for each real step.
        between: real steps from one new beginning of the networks to the next, where there are any.
        said: what sets a ratio.
    """
    return {
        f"ratio {ratio:g}, {'resets' if steps else 'plain'}, rate {rate:g}, {length}-step": {
            **said(ratio),
            f"{agent}.reset_every": round(steps * ratio),
            f"{hparams}.learning_rate": rate,
            f"{agent}.n_step": length,
        }
        for ratio, steps, rate, length in product(ratios, (0, between), RATES, TARGETS)
    }


def dreams(counts: Sequence[int], kept: int) -> Rows:
    """A DQN that dreams ``counts`` episodes a real one, and keeps so many steps of each."""
    return {
        f"dreams {count}, share {share:g}, rate {rate:g}, {length}-step": {
            "dyna.dream_episodes": count,
            "agent.fake_capacity": kept * count,
            "hparams.agent.fake_share": share,
            "hparams.agent.learning_rate": rate,
            "agent.n_step": length,
        }
        for count, share, rate, length in product(counts, SHARES, RATES, TARGETS)
    }


def grid(
    name: str, title: str, of: Experiment, arm: str,
    rows: Callable[[Any], Mapping[str, Overrides]],
) -> Study:  # fmt: skip
    """The study of a grid in ``tuned``, from best to worst; runs end once they have solved."""
    return Study(
        name=name, title=title, of=of, preset="tuned", rows=rows, arm=arm,
        common={"stop_after_solved": 0, "dyna.eval_every": 0},
        sections=(ranking(rows), report.settings, report.spent))  # fmt: skip


def both_grids(
    world: str, of: Experiment, ratios: Sequence[float], between: int, counts: Sequence[int],
    kept: int,
) -> tuple[Study, Study]:  # fmt: skip
    """Those of a DQN in a world, called so in titles; for numbers see `baselines` and `dreams`."""
    alone = grid(
        "baselines", f"The strongest agent without a model in {world}", of, "model_free",
        lambda options: baselines(
            "agent", "hparams.agent", ratios, between,
            lambda ratio: {"agent.updates": round(ratio * options.steps)}))  # fmt: skip
    return alone, grid(
        "dyna_grid", f"Dyna in {world}, with as many settings", of, "dyna",
        lambda options: dreams(counts, kept))  # fmt: skip

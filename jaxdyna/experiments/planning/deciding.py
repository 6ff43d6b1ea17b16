"""What is compared: who decides, and who learns; settings and the experiment."""

from dataclasses import dataclass, replace
from typing import Any

import jax

from jaxdyna.experiments.cartpole.arms import SAID
from jaxdyna.experiments.cartpole.options import LEAN, CartPoleOptions, rule
from jaxdyna.experiments.cartpole.studies import OF
from jaxdyna.experiments.engine import Experiment, Overrides, Results, Study
from jaxdyna.experiments.planning import report
from jaxdyna.experiments.planning.budgets import measure
from jaxdyna.experiments.planning.grounds import Sizes, cartpole_ground, maze_ground
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.rows import rows
from jaxdyna.fields import changed, setting
from jaxdyna.planners import require_mctx

GROUNDS = {"cartpole": cartpole_ground, "maze": maze_ground}
GROUND_KEY = 2**32 - 2  #: folded into the base seed's key: the runs' own keys are its first splits
IMITATE = ("dyna", "mpc_init", "mpc_init_dyna", "mpc_clone")
ROWS: dict[str, Overrides] = {
    **{name: {"arm": name} for name in IMITATE},
    **{f"{name}, 20 model updates": {"arm": name, "dyna.model_updates": 20} for name in IMITATE},
    **{name: {"arm": name} for name in ("mpc", "model_free")},
}


@dataclass(frozen=True, kw_only=True)
class PlanningOptions(CartPoleOptions):
    """Planners beside policies: what they cost and earn; the runs' settings are CartPole's."""

    grounds: tuple[str, ...] = setting(
        tuple(GROUNDS), "where decisions are timed and played", choices=tuple(GROUNDS),
        everyday=True)  # fmt: skip
    sizes: Sizes = setting(factory=Sizes)


def arms(options: PlanningOptions) -> Any:
    """CartPole's, once it is known that searches can be made."""
    if options.grounds:
        require_mctx()
    return OF.arms(options)


def budgets(options: PlanningOptions, say: Any) -> list[Results]:
    """What decisions cost and earn, a row a contender."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(options.seed), GROUND_KEY), 2)
    found = []
    for (name, make), key in zip(GROUNDS.items(), keys, strict=True):
        if name in options.grounds:
            say(f"{name}: learning a model and a policy ...")
            for ground, contenders in make(key, options.sizes):
                found += measure(ground, contenders, say)
    return found


LEAST = {
    "seeds": 2, "episodes": 110, "arms": ("dyna", "mpc_init", "mpc"),
    "sizes.runs": (1, 1), "sizes.cartpole_episodes": 15, "sizes.maze_episodes": (20,),
    "sizes.played": (4, 4), "sizes.candidates": (32,), "sizes.simulations": (8,),
    "sizes.board": (6, 1, 40)}  # fmt: skip
BASE = changed(
    PlanningOptions(**vars(LEAN)),
    {"seeds": 12, "episodes": 180, "stop_after_solved": 0, "dyna.eval_every": 0},
)
STUDY = Study(
    name="planning",
    title="Planning on the learned model, or learning from it?",
    of=replace(OF, arms=arms, presets={"lean": BASE}),
    preset="lean",
    rows=lambda options: ROWS,
    describe=(report.describe,),
    quick=LEAST,
    sections=(
        report.decisions, rows("first_solved"), sections.arms_said(SAID),
        sections.solved_share(rule), sections.distribution, report.robust, sections.settings,
        sections.spent,
    ),
)  # fmt: skip
PLANNING: Experiment = replace(STUDY.experiment(), measures={"budgets": budgets})

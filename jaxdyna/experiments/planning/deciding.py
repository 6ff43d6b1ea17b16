"""What is compared: who decides, and who learns; settings and the experiment."""

from dataclasses import dataclass, fields, replace
from typing import Any

import jax

from jaxdyna.experiments.cartpole.arms import SAID
from jaxdyna.experiments.cartpole.options import LEAN, CartPoleOptions, rule
from jaxdyna.experiments.cartpole.studies import OF
from jaxdyna.experiments.engine import Experiment, Results, Study
from jaxdyna.experiments.planning import claim, report
from jaxdyna.experiments.planning.budgets import measure
from jaxdyna.experiments.planning.grounds import Sizes, cartpole_ground, maze_ground
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.rows import rows
from jaxdyna.fields import changed, setting
from jaxdyna.planners import require_mctx

GROUNDS = {"cartpole": cartpole_ground, "maze": maze_ground}
CONTENDERS = (
    "policy", "MPC (true world)", "MPC (learned world)", "MCTS (true world)",
    "MCTS (learned world)", "MPC to the goal (true world)", "MPC, learned values (true world)",
    "MPC, learned values (learned world)", "MCTS, learned values (true world)",
    "MCTS, learned values (learned world)",
)  # fmt: skip
GROUND_KEY = 2**32 - 2
"""Folded into the base seed's key: the runs' own keys are its first splits."""
IMITATE = ("dyna", "mpc_init", "mpc_init_dyna", "mpc_clone")
POORER = {"": {}, ", 20 model updates": {"dyna.model_updates": 20},
          ", 5 model updates": {"dyna.model_updates": 5}}  # fmt: skip
ROWS: dict[str, dict[str, Any]] = {
    f"{name}{said}": {"arm": name, **change} for said, change in POORER.items() for name in IMITATE
} | {name: {"arm": name} for name in ("mpc", "mcts", "model_free")}
PLAYED = (*IMITATE, *(f"{name}, 20 model updates" for name in IMITATE), "mpc", "model_free")


@dataclass(frozen=True, kw_only=True)
class PlanningOptions(CartPoleOptions):
    """Planners beside policies: what a decision costs, what it earns, who learns sooner. The runs'
    settings are CartPole's.
    """

    grounds: tuple[str, ...] = setting(
        tuple(GROUNDS), "where decisions are timed and played", choices=tuple(GROUNDS),
        everyday=True,
    )  # fmt: skip
    contenders: tuple[str, ...] = setting(
        CONTENDERS, "who decides there: the policy, and planners by what they are told and plan in",
        choices=CONTENDERS,
    )  # fmt: skip
    sizes: Sizes = setting(factory=Sizes)

    def __post_init__(self) -> None:
        super().__post_init__()
        if "policy" not in self.contenders:
            raise ValueError("--contenders: the policy is what planners are compared with; add it")


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
            for ground, tried in make(key, options.sizes):
                chosen = (who for who in tried if who.label in options.contenders)
                found += measure(ground, chosen, say)
    return found


LEAST = {
    "seeds": 2, "episodes": 110, "arms": ("dyna", "mpc_init", "mpc"),
    "contenders": tuple(label for label in CONTENDERS if "true" not in label),
    "sizes.runs": (1, 1), "sizes.cartpole_episodes": 15, "sizes.maze_episodes": (20,),
    "sizes.played": (4, 4), "sizes.candidates": (32,), "sizes.simulations": (8,),
    "sizes.board": (6, 1, 40),
}  # fmt: skip
BASE = changed(
    PlanningOptions(**{item.name: getattr(LEAN, item.name) for item in fields(LEAN)}),
    {"seeds": 12, "episodes": 180, "stop_after_solved": 0},
)
STUDY = Study(
    name="planning",
    title="Planning on the learned model, or learning from it?",
    of=replace(OF, arms=arms, presets={"lean": BASE}),
    preset="lean",
    rows=lambda options: ROWS,
    common={"arms": PLAYED},
    describe=(claim.describe,),
    quick=LEAST,
    sections=(
        report.decisions, rows("first_solved"), sections.arms_said(SAID),
        sections.solved_share(rule), sections.distribution, report.robust, sections.settings,
        sections.spent,
    ),
)  # fmt: skip
PLANNING: Experiment = replace(STUDY.experiment(), measures={"budgets": budgets})

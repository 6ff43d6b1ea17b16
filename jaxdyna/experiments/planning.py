"""Planners on the learned model against learning from it (§1, §1.1).

``python -m jaxdyna.experiments.planning`` measures what decisions cost and what they earn, in
CartPole and in the Maze, and plays CartPole with a planner that acts, with one that a policy
imitates before it learns on, and with dreams, each with good and with poor models.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
from rich.console import Console

from jaxdyna.experiments import cli
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import LEAN
from jaxdyna.experiments.cartpole_report import IMITATES
from jaxdyna.experiments.planning_budgets import measure
from jaxdyna.experiments.planning_grounds import Sizes, cartpole_ground, maze_ground
from jaxdyna.experiments.planning_report import PlanningReport
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.session import Session
from jaxdyna.experiments.variants import VariantOptions, Variants
from jaxdyna.planners import require_mctx

GROUNDS = {"cartpole": cartpole_ground, "maze": maze_ground}
CONTENDERS = (
    "policy", "MPC (true world)", "MPC (learned world)", "MPC, its own models (learned world)",
    "CEM (learned world)", "MCTS (true world)", "MCTS (learned world)",
    "MCTS, Gumbel (learned world)", "MPC to the goal (true world)",
    "MPC, learned values (true world)", "MPC, learned values (learned world)",
    "CEM, learned values (learned world)", "MCTS, learned values (true world)",
    "MCTS, learned values (learned world)", "MCTS, Gumbel, learned values (learned world)",
)  # fmt: skip
GROUND_KEY = 2**32 - 2
"""Folded into the base seed's key: the runs' own keys are its first splits."""


@dataclass(frozen=True)
class Options(VariantOptions):
    """Planners beside policies: what a decision costs, what it earns, who learns sooner."""

    preset: str = "lean"
    """Only lean: whose models and policies are used."""
    quick: bool = False
    """A look at everything in two minutes: few runs, few budgets, a small board."""
    seeds: int = 12
    """Runs of every arm on CartPole."""
    episodes: int = 180
    """Real episodes of a run at the most."""
    arms: tuple[str, ...] = (
        "dyna", "mpc_init", "mpc_init_dyna", "mpc_clone", "dyna, 20 model updates",
        "mpc_init, 20 model updates", "mpc_init_dyna, 20 model updates",
        "mpc_clone, 20 model updates", "mpc", "model_free",
    )  # fmt: skip
    """Names of the arms to play on CartPole; there are also mcts, and all that imitate or dream
    with 5 model updates."""
    stop_after_solved: int | None = 0
    """Episodes an arm plays on once all its seeds have solved; None plays all of them."""
    grounds: tuple[str, ...] = tuple(GROUNDS)
    """Where decisions are timed and played: cartpole, maze."""
    contenders: tuple[str, ...] = CONTENDERS
    """Who decides there: the policy, and planners by what they are told and plan in."""
    sizes: Sizes = Sizes()
    """How much is played and tried there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if unknown := sorted(set(self.grounds) - set(GROUNDS)):
            there_are = " and ".join(GROUNDS)
            raise ValueError(f"--grounds: there is no {unknown[0]}; there are {there_are}")
        if unknown := sorted(set(self.contenders) - set(CONTENDERS)):
            there_are = "; ".join(CONTENDERS)
            raise ValueError(f"--contenders: there is no {unknown[0]}; there are: {there_are}")
        if "policy" not in self.contenders:
            raise ValueError("--contenders: the policy is what planners are compared with; add it")
        self.sizes.check()


FULL = Options()
QUICK = Options(
    quick=True,
    seeds=2,
    episodes=110,
    arms=("dyna", "mpc_init", "mpc"),
    contenders=(
        "policy",
        "MPC (learned world)",
        "MCTS (learned world)",
        "MPC, learned values (learned world)",
        "MCTS, learned values (learned world)",
    ),
    sizes=Sizes(
        runs=(1, 1),
        cartpole_episodes=15,
        maze_episodes=(20,),
        played=(4, 4),
        candidates=(32,),
        simulations=(8,),
        board=(6, 1, 40),
    ),
)


def variants(options: VariantOptions) -> dict[str, Arm]:
    """CartPole's arms by name, ``dyna`` first; each of the model's with good and poor ones."""
    base = replace(LEAN, seeds=options.seeds, episodes=options.episodes)
    models = {
        "": base,
        ", 20 model updates": replace(base, model_updates=20),
        ", 5 model updates": replace(base, model_updates=5),
    }
    arms = {}
    for said, setup in models.items():
        for name in ("dyna", *IMITATES):
            arms[f"{name}{said}"] = make_arms(replace(setup, arms=(cast(Any, name),)))[name]
    arms["mpc"] = make_arms(replace(base, arms=("mpc",)))["mpc"]
    if "mcts" in options.arms:  # the only one that needs mctx
        arms["mcts"] = make_arms(replace(base, arms=("mcts",)))["mcts"]
    arms["model_free"] = make_arms(base)["model_free"]
    return {name: arm._replace(dyna=arm.dyna._replace(diagnose=None)) for name, arm in arms.items()}


PLANNING = Variants(
    experiment="planning",
    title="Planning on the learned model, or learning from it?",
    default=FULL,
    make=variants,
    rule=LEAN.rule,
    real_first=LEAN.real_first,
    column="first_solved",
    block=LEAN.block,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    prog = PLANNING.prog
    options = cli.parse({"lean": QUICK if "--quick" in arguments else FULL}, arguments, prog)
    if options.preset != "lean":
        cli.fail(f"--preset is {options.preset}: there is lean", prog)
    try:
        if options.grounds:
            require_mctx()
        arms = variants(options)
    except (ImportError, ValueError) as error:
        cli.fail(str(error), prog)
    if unknown := sorted(set(options.arms) - set(arms)):
        cli.fail(f"--arms: there is no {'; '.join(unknown)}; there are: {'; '.join(arms)}", prog)
    out = options.out or Path("runs") / PLANNING.experiment
    console = Console(highlight=False)
    session = Session(
        experiment=PLANNING.experiment,
        prog=prog,
        argv=arguments,
        options=options,
        out=out,
        rule=PLANNING.rule,
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=PlanningReport(PLANNING, options),
        block=PLANNING.block,
        piece=10,
        slim_above=0,
        prelude=("budgets", lambda: budgets(options, console.print)),
        console=console,
    )
    return session.run({name: arms[name] for name in options.arms or arms})


def budgets(options: Options, say: Any) -> list[Results]:
    """What decisions cost and earn, a row a contender."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(options.seed), GROUND_KEY), 2)
    rows = []
    for (name, make), key in zip(GROUNDS.items(), keys, strict=True):
        if name in options.grounds:
            say(f"{name}: learning a model and a policy ...")
            for ground, tried in make(key, options.sizes, options.contenders):
                chosen = (who for who in tried if who.label in options.contenders)
                rows += measure(ground, chosen, say)
    return rows


if __name__ == "__main__":
    sys.exit(main())

"""What the comparison of planners and policies leaves behind: tables, sentences, figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Experiment, Record, Results
from jaxdyna.experiments.planning import claim, figures
from jaxdyna.experiments.report import rows
from jaxdyna.experiments.report.sections import Section, paragraphs
from jaxdyna.experiments.report.tables import interval, markdown_table
from jaxdyna.statistics import episodes_to_solve


def decisions(record: Record) -> str:
    """What a decision costs, and what it earns."""
    budgets = record.results["budgets"]
    if not budgets:
        return ""
    figures.decisions(record.out / "decisions.png", budgets)
    return paragraphs(
        "## What a decision costs, and what it earns",
        *sentences(budgets),
        "![share of the return that could be had, against milliseconds a decision](decisions.png)",
        "Share: of the most that could be had in the same episodes (the Maze's by value iteration, "
        "CartPole's 200), with its 95% interval over the runs that learned (over the episodes "
        "where there are one or two). Gain: how much more than the policy's share, paired, "
        "likewise. Steps: of the world that is planned in, a decision. Milliseconds: of one call "
        f"for one environment, and a decision's part of a call for {budgets[0]['batch']}; a jitted "
        "call takes some hundredths of a millisecond whatever it does.",
        *(
            f"{name}:\n\n{markdown_table(*_table([row for row in budgets if name == row[PLACE]]))}"
            for name in dict.fromkeys(row[PLACE] for row in budgets)
        ),
        GROUNDS_SAID,
    )


def learning(record: Record) -> str:
    """What the arms are."""
    return paragraphs("## Acting, imitating, dreaming: CartPole", ARMS_SAID)


def shares(of: Experiment) -> Section:
    """The share of the runs that have solved, an arm with poorer models in its own colour."""

    def section(record: Record) -> str:
        if not record.curves:
            return ""
        assert of.rule is not None
        rule = of.rule(record.options)
        first, known = {}, {}
        for name, curves in record.curves.items():
            first[name] = episodes_to_solve(rule.score(curves), rule) - rule.window + 1
            played = np.isfinite(curves["real_return"]).sum(1).max()
            known[name] = int(played) - rule.window + 1
        figures.solved_shares(record.out / "solved.png", first, known)
        return "![share of the runs whose solving window has begun](solved.png)"

    return section


def robust(record: Record) -> str:
    """Whether dreams are more robust than an initialisation from a planner."""
    title = "## Sub-optimal trajectories, or an initialisation from MPC? (§1.1)"
    said = claim.answer(record.results)
    return paragraphs(title, *said) if said else ""


def summary(record: Record) -> list[Any]:
    """The tables in the terminal, and what they come to."""
    budgets = record.results["budgets"]
    header, lines = _table(budgets)
    named = [[row[PLACE], *line] for row, line in zip(budgets, lines, strict=True)]
    short = [[line[column] for column in (0, 1, 2, 3, 5)] for line in named]
    cost = [("What a decision costs and earns", (["environment", *header[:3], header[4]], short))]
    return [
        *(cost if budgets else []), *rows.summary("first_solved")(record), *sentences(budgets),
        *claim.sentences(record.results),
    ]  # fmt: skip


PLACE = "environment"

ARMS_SAID = (
    "`dyna` is the `lean` preset. `mpc` (random shooting) and `mcts` (tree search) act by planning "
    "on the model that they learn, from the same real episode on from which `dyna` dreams. In "
    "`mpc_init` (Nagabandi et al. 2018) `mpc` plays 20 of these, the policy imitates them, and "
    "model-free learning goes on; in `mpc_init_dyna` dreams go on instead, in `mpc_clone` nothing "
    "does. The models with fewer updates are poorer ones."
)
GROUNDS_SAID = (
    "Policy, values and model come from runs of `dyna` in the `lean` preset, and everybody plays "
    "some episodes with what each run has learned; times are the first run's. MPC is random "
    "shooting («its own models»: those that runs of `mpc` learned from a planner's episodes), CEM "
    "the cross-entropy method with as many sequences in three rounds. «To the goal» looks ahead "
    "half as far again as the goal is and is told nothing; a "
    "planner with learned values looks a few steps ahead and takes the run's Q-values for what "
    "comes after. MCTS is MuZero's search («Gumbel»: Gumbel MuZero's); in CartPole its leaves "
    "are worth what a random "
    "episode from them earns."
)


def sentences(budgets: list[Results]) -> list[str]:
    """How much longer planners take than the policy, and what that buys: a line an environment."""
    lines = []
    for name in dict.fromkeys(row["environment"] for row in budgets):
        here = [row for row in budgets if row["environment"] == name]
        policy = next(row for row in here if row["who"] == "policy")
        said = []
        for who in dict.fromkeys(row["who"] for row in here if row["world"] == "learned"):
            own = [row for row in here if row["who"] == who and row["world"] == "learned"]
            best = max(own, key=lambda row: (row["share"], -row["ms"]))
            ratio = best["ms"] / policy["ms"]
            apart = best["ms_in_batch"] / policy["ms_in_batch"]
            said.append(
                f"{who} at its best budget takes **{ratio:,.0f} times** as long "
                f"({best['ms']:.2g} ms; {apart:,.0f} times in a batch) for {best['share']:.3f} "
                f"({best['gain']:+.3f}, 95% interval {interval(best['gain_ci95'], 3)})"
            )
        lines.append(
            f"{name}: the policy decides in {policy['ms']:.2g} ms and earns "
            f"{policy['share']:.3f} of what could be had"
            + (f"; on the learned model {'; '.join(said)}." if said else ".")
        )
    return lines


def _table(budgets: list[Results]) -> tuple[list[str], list[list[str]]]:
    """A line a contender."""
    header = ["who decides (world)", "steps", "share (95% interval)", "gain (95% interval)", "ms"]
    return [*header, "ms in a batch"], [
        [
            f"{row['who']} ({row['world']})" if row["world"] != "-" else row["who"],
            f"{row['steps']:,}",
            f"{row['share']:.3f} ({interval(row['share_ci95'], 3)})",
            "-"
            if row["who"] == "policy"
            else f"{row['gain']:+.3f} ({interval(row['gain_ci95'], 3)})",
            f"{row['ms']:.3g}",
            f"{row['ms_in_batch']:.3g}",
        ]
        for row in budgets
    ]

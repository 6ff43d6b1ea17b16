"""What the comparison of planners and policies leaves behind: tables, sentences, figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from jaxdyna.experiments import planning_claim, plots_planning, report
from jaxdyna.experiments.planning_claim import LATER
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.experiments.variants import DIFFERENCE_SAID, Curves, VariantsReport


@dataclass(frozen=True)
class PlanningReport(VariantsReport):
    """The experiment's own part of a `jaxdyna.experiments.session.Session`."""

    def describe(self, curves: Curves) -> Results:
        """With ``later_return``, one a seed, where so many episodes are played."""
        described, returns = super().describe(curves), curves["real_return"]
        if returns.shape[1] >= LATER.stop:
            described["later_return"] = returns[:, LATER].mean(1).tolist()
        return described

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``variants.png``, ``solved.png`` and ``decisions.png``."""
        super().figures(out, curves, results)
        known = {
            name: values["real_return"].shape[1] - self.variants.rule.window + 1
            for name, values in curves.items()
        }
        first = {name: self.solved_at(values) for name, values in curves.items()}
        plots_planning.solved_shares(out / "solved.png", first, known)
        if results["budgets"]:
            plots_planning.decisions(out / "decisions.png", results["budgets"])

    def markdown(self, results: Results) -> str:
        """The report."""
        rule, first = self.variants.rule, next(iter(results["arms"]))
        parts = [
            f"# {self.variants.title}",
            f"`{results['command']}`",
            *_decisions(results["budgets"]),
            "## Acting, imitating, dreaming: CartPole",
            f"{report.runs(self.options.seeds)} an arm. {str(rule).capitalize()}. At most "
            f"{self.options.episodes} episodes; a mean with an unsolved run in it is shown as its "
            f"lower bound (≥). The difference to «{first}» is paired (the same seeds); "
            f"{DIFFERENCE_SAID}",
            markdown_table(*self._long_table(results)),
            ARMS_SAID,
            "![every run of every arm](variants.png)",
            "![share of the runs whose solving window has begun](solved.png)",
            "`first_solved` in quantiles over the runs:",
            markdown_table(*report.quantile_table(results, "first_solved")),
            "## Sub-optimal trajectories, or an initialisation from MPC? (§1.1)",
            *planning_claim.answer(results),
            self._time(results),
        ]
        return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The tables in the terminal, and what they come to."""
        budgets = results["budgets"]
        if budgets:
            report.print_table(console, "What a decision costs and earns", *_short(budgets))
        super().summary(console, results)
        for line in (*sentences(budgets), *planning_claim.sentences(results)):
            console.print(line.replace("**", ""))

    def _time(self, results: Results) -> str:
        timing = results["timing"]
        rows = [["decisions: learning, playing, timing", "", f"{timing['prelude_s']:.0f}"]]
        rows += [
            [name, f"{arm['compile_s']:.0f}", f"{arm['run_s']:.0f}"]
            for name, arm in timing["arms"].items()
        ]
        return "## Time\n\n" + markdown_table(["arm", "compiling (s)", "running (s)"], rows)


def _decisions(budgets: list[Results]) -> list[str]:
    if not budgets:
        return []
    return [
        "## What a decision costs, and what it earns",
        *sentences(budgets),
        "![share of the return that could be had, against milliseconds a decision](decisions.png)",
        "Share: of the most that could be had in the same episodes (the Maze's by value iteration, "
        "CartPole's 200), with its 95% interval over the runs that learned (over the episodes "
        "where there are one or two). Gain: how much more than the policy's share, paired, "
        "likewise. "
        "Steps: of the world that is planned in, a decision. Milliseconds: of one call for one "
        f"environment, and a decision's part of a call for {budgets[0]['batch']}; a jitted call "
        "takes some hundredths of a millisecond whatever it does.",
        markdown_table(*_long(budgets)),
        GROUNDS_SAID,
    ]


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


def sentences(rows: list[Results]) -> list[str]:
    """How much longer planners take than the policy, and what that buys: a line an environment."""
    lines = []
    for name in dict.fromkeys(row["environment"] for row in rows):
        here = [row for row in rows if row["environment"] == name]
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


def _long(rows: list[Results]) -> tuple[list[str], list[list[str]]]:
    header = ["environment", "who decides", "world", "steps", "share", "95% interval",
              "gain (95% interval)", "ms", "ms in a batch"]  # fmt: skip
    return header, [
        [
            row["environment"],
            row["who"],
            row["world"],
            f"{row['steps']:,}",
            f"{row['share']:.3f}",
            interval(row["share_ci95"], 3),
            "-"
            if row["who"] == "policy"
            else f"{row['gain']:+.3f} ({interval(row['gain_ci95'], 3)})",
            f"{row['ms']:.3g}",
            f"{row['ms_in_batch']:.3g}",
        ]
        for row in rows
    ]


def _short(rows: list[Results]) -> tuple[list[str], list[list[str]]]:
    header, long = _long(rows)
    kept = [0, 1, 2, 3, 4, 7]
    return [header[column] for column in kept], [[row[column] for column in kept] for row in long]

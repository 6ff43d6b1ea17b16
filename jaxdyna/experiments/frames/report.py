"""What frame models leave behind: tables of scores, Fig. 7, dreams, rewards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Record
from jaxdyna.experiments.frames.judging import THRESHOLDS
from jaxdyna.experiments.frames.scores import SCORES, Scored, f1, used_threshold
from jaxdyna.experiments.report import frames as pictures
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.tables import Table, interval, markdown_table, with_interval
from jaxdyna.statistics import bootstrap_interval

SHOWN_THRESHOLDS = ("0.1", "0.2", "0.5")
SHARP = 0.8


def plainly(options: Any, stack: np.ndarray) -> np.ndarray:
    """A stack of frames on black as one picture in [0, 1], the older frames fainter."""
    return pictures.trail(stack / 255)


@dataclass(frozen=True, kw_only=True)
class FrameReport(Scored):
    """The report's sections, each a method; a world leaves out or adds some.

    Attributes:
        about: ``(record) -> Markdown``: what was done.
        said: what each model is.
        stage: what an arm's stage is, over a column.
        scores: of `SCORES`, those that are shown.
        paper: by stage the paper's own figures of the first of them, by class.
        moving: the class that a loss may blur; None tells of none.
        prefer: ``(options, stages) -> stage`` at which models are compared.
        dreamers: models whose stages and dreams are shown; all by default.
        filmed: dreamers that the film shows, where there are any of them; all by default.
        rules: what the rules of `Asked` are called.
        seen: ``(options, stack) -> picture`` in [0, 1] of the stack before a step.
    """

    about: Callable[[Record], str]
    said: Mapping[str, str] = field(default_factory=dict)
    stage: str = "episodes"
    scores: Sequence[str] = ("f1",)
    paper: Mapping[str, Sequence[float]] = field(default_factory=dict)
    moving: str | None = None
    prefer: Callable[[Any, list[str]], str] = lambda options, stages: stages[-1]
    dreamers: Sequence[str] = ()
    filmed: Sequence[str] = ()
    rules: Mapping[str, str] = field(default_factory=lambda: {"lit": "threshold"})
    seen: Callable[[Any, np.ndarray], np.ndarray] = plainly

    @property
    def sections(self) -> tuple[sections.Section, ...]:
        """All of them."""
        return (self.opening, self.by_stage, self.losses, self.rewards, self.dreams,
                sections.arms_said(self.said), sections.settings, sections.spent)  # fmt: skip

    def opening(self, record: Record) -> str:
        """What was done, and the scores."""
        return paragraphs(self.about(record), markdown_table(*self.score_table(record)))

    def by_stage(self, record: Record) -> str:
        """Fig. 7 of every dreamer that has several stages."""
        drawn = [
            self.grid(record, f"fig7_{arm}.png", stages,
                      f"{arm}: input, truth, belief and error, by {self.stage}")
            for arm, stages in self.models(record).items()
            if len(stages) > 1 and self.dreams_of(arm)
        ]  # fmt: skip
        return paragraphs(*drawn)

    def losses(self, record: Record) -> str:
        """What each loss makes of a picture and which threshold serves it, at one stage."""
        stage, names = self.compared(record)
        curves = {arm: record.curves[name] for arm, name in names.items()}
        pictures.score_by_threshold(
            record.out / "thresholds.png", THRESHOLDS,
            {arm: f1(judged["one_step"]) for arm, judged in curves.items()}, self.classes,
            {arm: THRESHOLDS[used_threshold(judged)] for arm, judged in curves.items()},
        )  # fmt: skip
        return paragraphs(
            "## Losses and thresholds",
            f"{self.stage.capitalize()}: {stage}. Believed: how sure the model is of a pixel that "
            "is lit, 1 at best. Spilled: what it believes of others, for each that is lit, 0 at "
            "best. "
            f"{self.blur_said(record)}",
            markdown_table(*self.score_table(record, ("believed", "spilled"), names.values())),
            "F1 by threshold; the best one is chosen on the held-out episodes themselves.",
            markdown_table(*self.threshold_table(record)),
            sections.figure(record, "thresholds.png", "F1 against threshold"),
            self.grid(record, "losses.png", names, "one step of each model"),
        )

    def rewards(self, record: Record) -> str:
        """How many rewards are predicted right, by what the step earned."""
        rows = []
        for arm in record.results["arms"].values():
            shares = [arm["reward_right"].get(kind) for kind in self.kinds]
            if any(shares):
                cells = [
                    f"{with_interval(share, 3)} of {share['steps']:,}" if share["steps"]
                    else "no such step" for share in shares
                ]  # fmt: skip
                rows.append([arm["arm"], arm["setting"], *cells])
        return paragraphs(
            "## Rewards",
            "Share predicted to within half the smallest reward, by what happened."
            if rows else "Not predicted.",
            markdown_table(["model", self.stage, *self.kinds], rows) if rows else "",
        )  # fmt: skip

    def dreams(self, record: Record) -> str:
        """Scores against dreamed steps, and a film."""
        names = self.last(record)
        if not names:
            return ""
        shown, [score, *_] = {}, self.scores
        for arm, name in names.items():
            for rule, called in self.rules.items():
                label = arm if len(self.rules) == 1 else f"{arm}, {called}"
                shown[label] = SCORES[score](record.curves[name][f"dream_{rule}"])
        what = f"{_called(score)} on held-out episodes"
        pictures.score_by_horizon(record.out / "horizon.png", shown, self.classes, what)
        asked = [arm for arm in self.filmed if arm in names] or names
        films = {arm: record.curves[names[arm]] for arm in asked}
        films = {arm: curves for arm, curves in films.items() if "show_film_dream" in curves}
        if films:
            truth = {"truth": next(iter(films.values()))["show_film_truth"]}
            dreamed = {arm: curves["show_film_dream"] for arm, curves in films.items()}
            pictures.film(record.out / "dream.gif", truth | dreamed)
        return paragraphs(
            "## Dreams",
            "So many steps fed with its own frames, actions as recorded, in the held-out episodes."
            + (" Frames are lit above the threshold, or each pixel is drawn with the probability "
               "that it is believed to be lit. " + self.drift_said(record)
               if len(self.rules) > 1 else ""),
            markdown_table(*self.dream_table(record)),
            sections.figure(record, "horizon.png", f"{_called(score)} against dreamed steps"),
            sections.figure(record, "dream.gif", "dreams beside the truth"),
        )  # fmt: skip

    def summary(self, record: Record) -> list[tuple[str, Table] | str]:
        """The scores in the terminal."""
        header, rows = self.score_table(record, digits=3, ends=False)
        seconds = f"{record.results['timing']['total_s']:.0f} s in all"
        return [("Predicted frames, on new episodes", (header, rows)), seconds]

    def score_table(
        self, record: Record, scores: Sequence[str] = (), names: Any = None, digits: int = 3,
        ends: bool = True,
    ) -> Table:  # fmt: skip
        """Scores by model, stage and class, the paper's own figures above."""
        known = record.results["arms"]
        rows = [] if scores else [
            ["paper's figures", stage, *(["F1"] if len(self.scores) > 1 else []),
             *(f"{score:.2f}" for score in said)]
            for stage, said in self.paper.items()
        ]  # fmt: skip
        scores = scores or self.scores
        for arm in (known[name] for name in names or known):
            for score in scores:
                summaries = [arm[score][name] for name in self.classes]
                cells = [with_interval(one if ends else one | {"ci95": None}, digits)
                         for one in summaries]  # fmt: skip
                named = [_called(score)] if len(scores) > 1 else []
                rows.append([arm["arm"], arm["setting"], *named, *cells])
        return ["model", self.stage, *(["score"] if len(scores) > 1 else []), *self.classes], rows

    def threshold_table(self, record: Record) -> Table:
        """F1 by model, class and threshold, and at the best of all thresholds."""
        rows = []
        for arm, name in self.compared(record)[1].items():
            by_threshold = record.results["arms"][name]["f1_by_threshold"]
            for one in self.classes:
                means = {mark: f1[one] for mark, f1 in by_threshold.items()}
                best = max(means, key=lambda mark: means[mark])
                cells = [f"{means[mark]:.3f}" for mark in SHOWN_THRESHOLDS]
                rows.append([arm, one, *cells, f"{means[best]:.3f} at {best}"])
        header = ["model", "F1 of", *(f"> {mark}" for mark in SHOWN_THRESHOLDS), "best here"]
        return header, rows

    def dream_table(self, record: Record, suffix: str = "") -> Table:
        """Scores by dreamed steps, after the last stage; with the suffix ``_apart`` of those steps
        that were counted apart, and of how many.
        """
        rows, several = [], len(self.scores) > 1
        for arm, name in self.last(record).items():
            for rule, called in self.rules.items():
                model = arm if len(self.rules) == 1 else f"{arm}, {called}"
                for step, said in record.results["arms"][name]["dreams"][f"{rule}{suffix}"].items():
                    count = f"{step} (of {said['dreams']})" if "dreams" in said else step
                    for score in self.scores:
                        cells = [with_interval(said[score][one], 3) for one in self.classes]
                        wrong = f"{100 * said['wrong']['mean']:.2f}%"
                        extra = ([_called(score)], []) if several else ([], [wrong])
                        rows.append([model, count, *extra[0], *cells, *extra[1]])
        before, after = (["score"], []) if several else ([], ["wrong pixels"])
        return ["model", "step", *before, *self.classes, *after], rows

    def blur_said(self, record: Record) -> str:
        """What each loss did to the class that may blur, in words."""
        if self.moving is None:
            return ""
        said = []
        for arm, name in self.compared(record)[1].items():
            judged = record.results["arms"][name]
            sure, spilled = (judged[part][self.moving]["mean"] for part in ("believed", "spilled"))
            what = "sharp" if sure > SHARP else ("blurred" if spilled > 1 - SHARP else "dark")
            said.append(f"`{arm}` is {what} ({sure:.2f}, {spilled:.2f})")
        return (
            f"{self.moving.capitalize()} (believed, spilled): {'; '.join(said)}. Sharp: more than "
            f"{SHARP:g} believed; otherwise blurred where more than {1 - SHARP:g} is spilled, or "
            "else dark."
        )

    def drift_said(self, record: Record) -> str:
        """Which of two rules drifts less, in words; dreams of a run begin alike, so that their
        difference is paired.
        """
        said, (first, second), [score, *_] = [], list(self.rules)[:2], self.scores
        one = self.moving or self.classes[0]
        for arm, name in self.last(record).items():
            dreams = record.results["arms"][name]["dreams"]
            step = [step for step in dreams[first] if int(step) <= 10][-1]
            a, b = (
                np.array(dreams[rule][step][score][one]["per_seed"]) for rule in (first, second)
            )
            low, high = bootstrap_interval(a - b, lambda rows: rows.mean(-1)) or (None, None)
            verdict = "they cannot be told apart"
            if low is not None and high is not None and low * high > 0:
                verdict = f"{self.rules[first if low > 0 else second]} drifts less"
            said.append(
                f"After {step} steps `{arm}` has {_called(score)} {a.mean():.3f} of {one} by "
                f"{self.rules[first]} and {b.mean():.3f} {self.rules[second]}, a difference of "
                f"{(a - b).mean():.3f} ({interval([low, high], 3)}): {verdict}."
            )
        return " ".join(said)

    def grid(self, record: Record, file: str, names: Mapping[str, str], said: str) -> str:
        """A step as each of some arms predicts it, a row an arm, by what the row is called."""
        curves = {label: record.curves[name] for label, name in names.items()}
        curves = {label: shown for label, shown in curves.items() if "show_seen" in shown}
        if not curves:
            return ""
        rows = {
            label: (shown["show_truth"] / 255, shown["show_belief"])
            for label, shown in curves.items()
        }
        seen = self.seen(record.options, next(iter(curves.values()))["show_seen"])
        pictures.prediction_grid(record.out / file, rows, seen)
        return f"![{said}]({file})"

    def models(self, record: Record) -> dict[str, dict[str, str]]:
        """The arms' full names by model and stage."""
        found: dict[str, dict[str, str]] = {}
        for name, arm in record.results["arms"].items():
            found.setdefault(arm["arm"], {})[arm["setting"]] = name
        return found

    def compared(self, record: Record) -> tuple[str, dict[str, str]]:
        """Of the stages that most models have finished the preferred one; its arms by model."""
        at: dict[str, dict[str, str]] = {}
        for arm, stages in self.models(record).items():
            for stage, name in stages.items():
                at.setdefault(stage, {})[arm] = name
        most = max(map(len, at.values()))
        stage = self.prefer(record.options, [stage for stage in at if len(at[stage]) == most])
        return stage, at[stage]

    def last(self, record: Record) -> dict[str, str]:
        """By dreamer the arm of its last stage."""
        models = self.models(record)
        return {arm: [*models[arm].values()][-1] for arm in models if self.dreams_of(arm)}

    def dreams_of(self, arm: str) -> bool:
        """Whether a model's dreams are shown."""
        return not self.dreamers or arm in self.dreamers


def _called(score: str) -> str:
    return "F1" if score == "f1" else score

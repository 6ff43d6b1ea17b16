"""What frame models leave behind: tables of scores, Fig. 7, dreams, rewards."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Record, Results
from jaxdyna.experiments.frames.judging import THRESHOLDS
from jaxdyna.experiments.frames.scores import SCORES, f1, scored, used_threshold
from jaxdyna.experiments.report import frames as pictures, plots, sections
from jaxdyna.experiments.report.sections import grouped, paragraphs
from jaxdyna.experiments.report.summaries import Curves
from jaxdyna.experiments.report.tables import Table, markdown_table, with_interval

WHOSE = ("new", "old")  #: episodes whose losses are looked at
DREAM = "show_film_dream"  #: of the first run, where it was played, as all other pictures


@dataclass(frozen=True, kw_only=True)
class FrameReport:
    """The report's sections, each a method; a world leaves out or adds some."""

    classes: tuple[str, ...]  #: see `scored`
    about: Callable[[Record], str]  #: ``(record) -> Markdown``: what was done
    kinds: tuple[str, ...] = ()  #: see `scored`
    said: Mapping[str, str] = field(default_factory=dict)  #: what each model is
    stage: str = "episodes"  #: what an arm's stage is, over a column
    scores: Sequence[str] = ("f1",)  #: of `SCORES`, those that are shown
    #: by stage the paper's own figures of the first of them, by class
    paper: Mapping[str, Sequence[float]] = field(default_factory=dict)
    #: ``(options, stages) -> stage`` at which models are compared
    prefer: Callable[[Any, list[str]], str] = lambda options, stages: stages[-1]
    #: models whose dreams are filmed, where there are any of them; all by default
    filmed: Sequence[str] = ()
    #: what the rules of `Asked` are called
    rules: Mapping[str, str] = field(default_factory=lambda: {"lit": "threshold"})
    #: ``(options, stack) -> picture`` in [0, 1] of the stack before a step; by default of one on
    #: black, the older frames fainter
    seen: Callable[[Any, np.ndarray], np.ndarray] = lambda _, stack: pictures.trail(stack / 255)

    def describe(self, options: Any, curves: Curves) -> Results:
        """An arm's entries."""
        return scored(self.classes, self.kinds, curves)

    @property
    def sections(self) -> tuple[sections.Section, ...]:
        """All of them."""
        return (self.opening, self.training, self.by_stage, self.losses, self.rewards, self.dreams,
                sections.arms_said(self.said), sections.settings, sections.spent)  # fmt: skip

    def opening(self, record: Record) -> str:
        """What was done, and the scores."""
        return paragraphs(self.about(record), markdown_table(*self.score_table(record)))

    def training(self, record: Record) -> str:
        """Each model's loss of a frame, on new and on old episodes; empty where nobody looked."""
        every = record.options.loss_every
        looks = {
            name: {whose: one[f"{whose}_loss"][:, every - 1 :: every] for whose in WHOSE}
            for name, one in record.curves.items()
            if "new_loss" in one and one["new_loss"].shape[1] >= every
        }
        if not looks:
            return ""
        panels = {f"{name}: loss of a frame": losses for name, losses in looks.items()}
        steps = every * np.arange(1, 1 + max(losses["new"].shape[1] for losses in looks.values()))
        drawn = plots.bands(
            record.out / "training.png", panels, "gradient steps", at=steps, log=True
        )
        header = [f"{whose}, after {part}" for whose in WHOSE for part in ("half", "all")]
        rows = [[name, *(f"{loss:.4g}" for whose in WHOSE for loss in _half_and_all(losses[whose]))]
                for name, losses in looks.items()]  # fmt: skip
        return paragraphs(
            "## Whether training is at its end",
            f"A model's own loss of a frame every {every:,} gradient steps, on transitions of the "
            "held-out episodes (new) and on as many of those that are learned from (old), the same "
            "ones each time; a batch is normalised by itself, as in training. Mean over runs after "
            "half and after all of the steps. Where more steps lower that on new, training was too "
            "short; where they lower that on old alone, data is too little.",
            markdown_table(["model", *header], rows),
            "![a model's loss of a frame against gradient steps](training.png)" if drawn else "",
        )

    def by_stage(self, record: Record) -> str:
        """Fig. 7 of every model that has several stages."""
        said = f"input, truth, belief and error, by {self.stage}"
        return paragraphs(*(
            self.grid(record, f"fig7_{arm}.png", stages, f"{arm}: {said}")
            for arm, stages in grouped(record).items() if len(stages) > 1))  # fmt: skip

    def losses(self, record: Record) -> str:
        """What each loss makes of a picture and which threshold serves it, at one stage."""
        stage, names = self.compared(record)
        curves = {arm: record.curves[name] for arm, name in names.items()}
        self._draw(
            record.out / "thresholds.png",
            {arm: f1(judged["one_step"]) for arm, judged in curves.items()},
            "threshold (dot: the one used)", "F1", at=THRESHOLDS,
            dots={arm: [used_threshold(judged)] for arm, judged in curves.items()})  # fmt: skip
        return paragraphs(
            "## Losses and thresholds",
            f"{self.stage.capitalize()}: {stage}. Believed: how sure the model is of a pixel that "
            "is lit, 1 at best. Spilled: what it believes of others, for each that is lit, 0 at "
            "best: blur spills much, darkness believes and spills little.",
            markdown_table(*self.score_table(record, ("believed", "spilled"), names.values())),
            "![F1 against threshold](thresholds.png)",
            self.grid(record, "losses.png", names, "one step of each model"),
        )

    def rewards(self, record: Record) -> str:
        """How many rewards are predicted right, by what the step earned."""
        rows = [
            [arm["arm"], arm["setting"], *(
                f"{with_interval(share, 3)} of {share['steps']:,}" if share["steps"]
                else "no such step" for share in arm["reward_right"].values()
            )]
            for arm in record.results["arms"].values() if arm["reward_right"]]  # fmt: skip
        if not rows:
            return "## Rewards\n\nNot predicted."
        said = "Share predicted to within half the smallest reward, by what happened."
        table = markdown_table(["model", self.stage, *self.kinds], rows)
        return paragraphs("## Rewards", said, table)

    def dreams(self, record: Record) -> str:
        """Scores against dreamed steps, and a film."""
        names, score = self.last(record), self.scores[0]
        shown = {
            self.dreamer(arm, rule): SCORES[score](record.curves[name][f"dream_{rule}"])
            for arm, name in names.items()
            for rule in self.rules
        }
        self._draw(record.out / "horizon.png", shown, "dreamed steps", _called(score))
        asked = [arm for arm in self.filmed if arm in names] or [*names]
        shows = {arm: record.curves[names[arm]] for arm in asked}
        film = {arm: curves[DREAM] for arm, curves in shows.items() if DREAM in curves}
        if film:
            film = {"truth": shows[next(iter(film))]["show_film_truth"]} | film
            said = {
                name: [(frame, f"step {step}") for step, frame in enumerate(frames, start=1)]
                for name, frames in film.items()
            }
            pictures.film(record.out / "dream.gif", said)
        drawn = (
            " Frames are lit above the threshold, or each pixel is drawn with the probability that "
            "it is believed to be lit."
        ) if len(self.rules) > 1 else ""  # fmt: skip
        return paragraphs(
            "## Dreams",
            "So many steps fed with its own frames, actions as recorded, in the held-out episodes."
            f"{drawn}",
            markdown_table(*self.dream_table(record)),
            f"![{_called(score)} against dreamed steps](horizon.png)",
            "![dreams beside the truth](dream.gif)" if film else "",
        )

    def score_table(self, record: Record, scores: Sequence[str] = (), names: Any = None) -> Table:
        """Scores by model, stage and class, the paper's own figures above."""
        known = record.results["arms"]
        arms = [known[name] for name in names or known]
        parts = [([arm["arm"], arm["setting"]], arm) for arm in arms]
        header, rows = self._table(["model", self.stage], parts, scores or self.scores)
        paper = [
            ["paper's figures", stage, *(f"{score:.2f}" for score in said)]
            for stage, said in self.paper.items()
        ]
        return header, rows if scores else paper + rows

    def dream_table(self, record: Record, suffix: str = "") -> Table:
        """Scores by dreamed steps after the last stage; ``_apart``: of those counted apart."""
        parts = [
            ([self.dreamer(arm, rule), f"{step} (of {said['dreams']})" if suffix else step], said)
            for arm, name in self.last(record).items()
            for rule in self.rules
            for step, said in record.results["arms"][name]["dreams"][f"{rule}{suffix}"].items()
        ]
        header, rows = self._table(["model", "step"], parts, self.scores)
        if len(self.scores) == 1:
            header.append("wrong pixels")
            for row, (_, said) in zip(rows, parts, strict=True):
                wrong = said["wrong"]["mean"]
                row.append("-" if wrong is None else f"{100 * wrong:.2f}%")
        return header, rows

    def _table(
        self, first: Sequence[str], parts: Sequence[tuple[list[str], Any]], scores: Sequence[str]
    ) -> Table:
        """Scores by class, a row for each of some cells and scores."""
        several = len(scores) > 1
        rows = [
            [*cells, *([_called(score)] if several else []),
             *(with_interval(said[score][one], 3) for one in self.classes)]
            for cells, said in parts for score in scores]  # fmt: skip
        return [*first, *(["score"] if several else []), *self.classes], rows

    def _draw(self, path: Path, scores: Mapping[str, Any], x: str, y: str, **more: Any) -> None:
        """Scores by name ``[seeds, n, classes]``, a panel a class."""
        panels = {
            one: {name: values[..., number] for name, values in scores.items()}
            for number, one in enumerate(self.classes)
        }
        plots.bands(path, panels, x, f"{y} on held-out episodes", ylim=(-0.02, 1.02), **more)

    def grid(self, record: Record, file: str, names: Mapping[str, str], said: str) -> str:
        """A step as each of some arms predicts it, a row an arm, by what the row is called."""
        shows = {label: record.curves[name] for label, name in names.items()}
        rows = {
            label: (curves["show_truth"] / 255, curves["show_belief"])
            for label, curves in shows.items() if "show_truth" in curves}  # fmt: skip
        if not rows:
            return ""
        seen = self.seen(record.options, shows[next(iter(rows))]["show_seen"])
        pictures.prediction_grid(record.out / file, rows, seen)
        return f"![{said}]({file})"

    def compared(self, record: Record) -> tuple[str, dict[str, str]]:
        """Of the stages that most models have finished the preferred one; its arms by model."""
        at = grouped(record, "setting", "arm")
        most = max(map(len, at.values()))
        stage = self.prefer(record.options, [stage for stage in at if len(at[stage]) == most])
        return stage, at[stage]

    def last(self, record: Record) -> dict[str, str]:
        """The arms of the last stage by model."""
        return list(grouped(record, "setting", "arm").values())[-1]

    def dreamer(self, arm: str, rule: str) -> str:
        """A model, and by which rule its frames are made where there are several."""
        return arm if len(self.rules) == 1 else f"{arm}, {self.rules[rule]}"


def _half_and_all(values: np.ndarray) -> tuple[float, float]:
    """The mean over runs of ``[runs, looks]`` after half of the looks and after all."""
    means = values.mean(0)
    return means[(len(means) - 1) // 2], means[-1]


def _called(score: str) -> str:
    return "F1" if score == "f1" else score

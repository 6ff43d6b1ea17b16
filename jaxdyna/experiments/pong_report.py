"""What frame prediction in Pong leaves behind: Fig. 9 in numbers and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.envs.pong_screen import mixture_of
from jaxdyna.experiments import plots_frames, report
from jaxdyna.experiments import pong_scores as scores
from jaxdyna.experiments.pong_judge import OBJECTS, recall
from jaxdyna.experiments.pong_options import PALETTES, Options, config_of, game_of, training_of
from jaxdyna.experiments.report import Results, markdown_table
from jaxdyna.models import RectangleConfig

Curves = Mapping[str, Mapping[str, np.ndarray]]
SEEN = {"objects": "with each object in a channel of its own", "rgb": "in the game's colours (RGB)"}


def figures(out: Path, curves: Curves, options: Options) -> None:
    """``fig9.png``, ``fig9_random.png``, ``horizon.png``, ``dream.gif``."""
    by_policy: dict[str, dict[str, Mapping[str, np.ndarray]]] = {}
    for name, judged in curves.items():
        arm, _, policy = name.partition("@")
        by_policy.setdefault(policy, {})[arm] = judged
    for policy, arms in by_policy.items():
        rows = {arm: (judged["truth"], judged["belief"]) for arm, judged in arms.items()}
        seen = next(iter(arms.values()))["seen"]
        path = "fig9.png" if policy == _shown(by_policy) else f"fig9_{policy}.png"
        plots_frames.prediction_grid(out / path, rows, seen, partial(_coloured, options))
    arms = by_policy[_shown(by_policy)]
    plots_frames.score_by_horizon(
        out / "horizon.png",
        {arm: recall(judged["dream"]) for arm, judged in arms.items()},
        list(OBJECTS),
        what="recall on held-out episodes",
    )
    films = {name: arms[name] for name in ("ours", "adversarial", "l2") if name in arms} or arms
    columns = {"truth": next(iter(films.values()))["film_truth"]}
    columns |= {name: judged["film_dream"] for name, judged in films.items()}
    plots_frames.film(out / "dream.gif", columns)


def _coloured(options: Options, shares: np.ndarray) -> np.ndarray:
    """How so much of each object is seen, in [0, 1]."""
    return np.asarray(mixture_of(jnp.asarray(shares), PALETTES[options.frames])) / 255


def _shown(by_policy: Mapping[str, object]) -> str:
    """The policy whose models the main figures show."""
    return "mixed" if "mixed" in by_policy else next(iter(by_policy))


def markdown(results: Results, options: Options, curves: Curves, out: Path) -> str:
    """The report, with the figures that are in ``out``."""
    parts = [
        "# Pong: predicting frames (Fig. 9)",
        f"`{results['command']}`",
        _data_said(options),
        markdown_table(*scores.one_step(results)),
        "\n".join(f"- `{arm}`: {_setting(options, arm)}" for arm in results["arms"]),
        _picture(out, "fig9.png", "Fig. 9: input, truth, belief and error of a step, by model"),
        "Red is the opponent, green the own paddle, blue the ball."
        if options.frames == "objects"
        else "Errors are differences of colours, on black.",
        "## Blur",
        "Believed: how sure the model is of a pixel that shows the object, 1 at best. Spilled: "
        "what it believes of the object anywhere else in the frame, for each such pixel, 0 at "
        "best.",
        scores.random_said(results),
        markdown_table(*scores.blur(results)),
        _picture(out, "fig9_random.png", "the same models, trained on the random policy alone"),
        "## Dreams",
        f"So many steps fed with its own frames, actions as recorded, {options.dreams} from each "
        "held-out episode. Which way a ball is served is random: where a serve lies within the "
        "dream, no model can know the rest.",
        markdown_table(*scores.dreams(results)),
        *_unserved(results),
        _picture(out, "horizon.png", "recall against dreamed steps"),
        _picture(out, "dream.gif", "dreams beside the truth"),
        "## Time",
        "Of all runs together.",
        markdown_table(*scores.times(results)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def summary(console: Console, results: Results) -> None:
    """Recall one step ahead, in the terminal."""
    header, rows = scores.one_step(results)
    short = [[*row[:2], *(cell.partition(" ")[0] for cell in row[2:5])] for row in rows]
    report.print_table(console, "Recall of predicted frames", [*header[:2], *OBJECTS], short)
    console.print(f"{results['timing']['total_s']:.0f} s in all")


def _unserved(results: Results) -> list[str]:
    return [
        "The same of those dreams within which no ball is served up to that step:",
        markdown_table(*scores.dreams(results, "dream_unserved")),
    ]


def _data_said(options: Options) -> str:
    height, width, _ = game_of(options).frame_shape
    game = {
        "jax": f"The pure game, a ball served {options.serve_delay} of its frames after a point; "
        "where objects are is exact.",
        "ale": "The Atari 2600 game (`ALE/Pong-v5`, no action repeated at random), its screen "
        "reduced to the field; objects are told by their colours.",
    }[options.game]
    return (
        f"{report.runs(options.seeds)}. {game} Frames of {height}x{width} {SEEN[options.frames]}, "
        f"{options.frame_skip} of the game's a step. A model, four frames and the action in, the "
        f"next frame out, is trained on {options.episodes} episodes of {options.steps} steps of "
        "the "
        f"{' policy, or of as many of the '.join(options.stages_of(''))} policy. The mixed one is "
        "of players that follow the ball with a share of their actions that is drawn for each "
        "episode, and act at random with the others. All are judged on "
        f"{options.held_out} new episodes of the mixed policy: the share of an object's pixels "
        "that are predicted to be lit (recall), and of the pixels lit as its that are its "
        f"(precision; - where none is lit).{_shares_said(options)} Mean over runs and 95% interval."
    )


def _shares_said(options: Options) -> str:
    if options.frames == "objects":
        return ""
    return (
        " A predicted pixel is taken for a mixture of the background and that object with which it "
        "comes closest, and is lit from one half on. Our model sees the same frames; what it takes "
        "from them is where each colour is."
    )


def _setting(options: Options, arm: str) -> str:
    config, training = config_of(options, arm), training_of(options, arm)
    rates = "0.9, 0.999" if arm == "ours" else "0.5, 0.999"
    decay = training.weight_decay
    trained = (
        f"{training.updates:,} updates on batches of {training.batch}, "
        f"{'AdamW' if decay else 'Adam'} ({rates}) from {training.learning_rate:g} down along a "
        f"cosine{f', weight decay {decay:g}' if decay else ''}"
    )
    if isinstance(config, RectangleConfig):
        return (
            "the two edges of each object along each axis, a category for each row or column that "
            "one may come to lie in; the paddles first, then the ball, told where they have gone; "
            f"perceptrons of {options.hidden}, dropout {options.dropout:g}; {trained}; dreams take "
            "the likeliest places"
        )
    network = (
        f"Fig. 4 on patches of {options.patch}x{options.patch} pixels, {options.widths} channels, "
        f"kernels {options.kernels}, dense {options.dense}, {scores.SAID[arm]}"
    )
    if arm == "adversarial":
        network += (
            f", lambda {options.adversarial_weight:g}, in its non-saturating form (the printed "
            "sign would reward being seen through)"
        )
    shades = "in shades, lit from" if config.shades else "lit above"
    return f"{network}; {trained}; {shades} {config.threshold:g}"


def _picture(out: Path, name: str, said: str) -> str:
    return f"![{said}]({name})" if (out / name).exists() else ""

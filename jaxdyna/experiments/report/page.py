"""``report.html``: a report as one page for a browser, with its curves to be looked into.

The page loads nothing: figures, films, curves, script and style are in it, and a policy of its own
forbids everything else. Its curves and figures take 430 KB at the most: of long curves as many
points are taken, of very many arms as many drawn, and figures are as wide, as that allows.
"""

import base64
import gzip
import html
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import unquote

import numpy as np
from markdown_it import MarkdownIt
from markdown_it.token import Token
from PIL import Image

from jaxdyna.experiments.report import plots, tables
from jaxdyna.statistics import SolveRule, running_mean

#: of all curves and of all figures, as they stand in the page
CURVES_BYTES, FIGURES_BYTES = 230_000, 200_000
MANY = 1_000_000
#: points of a curve; single runs of returns, and of all else; arms and measures, of all the first:
#: the first that fit, or the last, which do
SIZES = (
    (200, 100, 100, MANY), (120, 100, 100, MANY), (120, 100, 10, MANY), (60, 100, 10, MANY),
    (60, 30, 10, MANY), (40, 10, 0, MANY), (40, 10, 0, 24))  # fmt: skip
#: pixels across a figure, likewise
WIDTHS = (1245, 900, 640, 400)
#: episodes in a running mean, as in the figures; a tenth of short runs
WINDOW = 20
#: that are told apart between the lowest and the highest value
HEIGHTS = 2000
#: how many times as large as the lowest the highest of values is that are drawn by their logarithm
LOGARITHMIC = 1000
RETURN = "real_return"


def page(record: Any, text: str, rule: SolveRule | None = None) -> str:
    """A record's report, of ``text`` in Markdown and its folder's figures, curves before these;
    the return at which runs have solved is a line among these.
    """
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    markdown.add_render_rule("image", _captioned)
    markdown.add_render_rule("table_open", lambda *_: '<div class="wide" tabindex="0"><table>\n')
    markdown.add_render_rule("table_close", lambda *_: "</table></div>\n")
    before, figure, after = text.partition("\n![")
    parts = [markdown.parse(part) for part in (before, figure + after)]
    _embed(parts[1], record.out)
    head, rest = (markdown.renderer.render(part, markdown.options, {}) for part in parts)
    told = json.dumps(curves(record, rule)).replace("<", "\\u003c")
    title = html.escape(text.splitlines()[0].strip("# ").replace("`", ""))
    own = (Path(__file__).with_name(f"page.{kind}") for kind in ("html", "css", "js"))
    whole, style, script = (path.read_text("utf-8") for path in own)
    return Template(whole).substitute(
        title=title, style=style, head=head, rest=rest, told=told, script=script
    )


def _captioned(renderer: Any, tokens: Sequence[Token], number: int, *rest: Any) -> str:
    """A picture with what it shows below it."""
    said = html.escape(tokens[number].content)
    shown = renderer.image(tokens, number, *rest)
    return f'<span class="wide" tabindex="0">{shown}</span><small>{said}</small>'


def _embed(tokens: Sequence[Token], folder: Path) -> None:
    """Puts pictures of the folder into the page, figures so small that all of them fit."""
    shown = [one for token in tokens for one in token.children or () if one.type == "image"]
    for width in WIDTHS:
        data = [_data(folder / unquote(str(one.attrs["src"])), width) for one in shown]
        if sum(len(one) for one in data if one.startswith("data:image/webp")) <= FIGURES_BYTES:
            break
    for one, url in zip(shown, data, strict=True):
        one.attrs["src"] = url


def _data(path: Path, width: int) -> str:
    """An address that is the picture: a film as it is, a figure at most so wide; empty if none."""
    if path.suffix not in (".gif", ".png") or not path.is_file():
        return ""
    kind, data = "gif", path.read_bytes()
    if path.suffix == ".png":
        kind, file = "webp", io.BytesIO()
        with Image.open(path) as picture:
            small = picture.convert("RGB")
        small.thumbnail((width, 10**6))
        small.save(file, "WEBP", quality=75, method=2)
        data = file.getvalue()
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def curves(record: Any, rule: SolveRule | None = None) -> Mapping[str, Any]:
    """What the script draws; nothing where nothing was played in episodes.

    Returns:
        ``arms``: name, colour and dashes, and how many ``more`` there are; ``runs``: their seeds,
        or what they go ``by``; ``episodes`` at which curves are told; ``measures``, each with its
        ``lowest`` and ``highest`` value, whether its heights are ``orders``, of its logarithm,
        ``arms``: number, points and single runs of each that has it, and of returns what is
        ``solved``, by the ``rule`` in words; ``packed``: the lines of all these in turn, see
        `_lines` and `_heights`.
    """
    played = {arm: own for arm, own in record.curves.items() if RETURN in own}
    longest = max((own[RETURN].shape[1] for own in played.values()), default=0)
    window = max(min(WINDOW, longest // 10), 1)
    measures = {
        name: {number: smoothed(own[name], window) for number, own in enumerate(played.values())
               if name in own and own[name].shape == own[RETURN].shape}
        for name in dict.fromkeys([RETURN, *(name for own in played.values() for name in own)])
    }  # fmt: skip
    solved = rule.threshold if rule and rule.share_of is None else None
    orders = {name: name != RETURN and _orders(arms) for name, arms in measures.items()}
    for points, runs, fewer, most in SIZES:
        at = np.unique(np.linspace(1, longest, min(points, longest)).round().astype(int))
        lines = {name: {number: _lines(values, at, runs if name == RETURN else fewer, orders[name])
                        for number, values in arms.items() if number < most}
                 for name, arms in [*measures.items()][:most]}  # fmt: skip
        told = [
            each
            for name, arms in lines.items()
            if (each := _heights(name, arms, orders[name], solved if name == RETURN else None))
        ]
        packed = base64.b64encode(gzip.compress(b"".join(each for _, each in told), mtime=0))
        if len(packed) <= CURVES_BYTES:
            break
    looks = [*zip(played, plots.looks([*played]), strict=True)][:most]
    return {
        "arms": [{"name": tables.label(arm), "color": color,
                  "dashes": [] if line == plots.SOLID else [2 * part for part in line[1]]}
                 for arm, (color, line) in looks],
        "runs": record.results["runs"]["seeds"], "by": record.results["runs"].get("by", "seed"),
        "more": len(played) - len(looks), "episodes": at.tolist(), "window": window,
        "rule": rule and f"solved: mean of {rule.window} at {rule.threshold:g}",
        "shaded": plots.shaded(record.results["runs"]["seeds"]), "heights": HEIGHTS,
        "measures": [measure for measure, _ in told], "packed": packed.decode(),
    } if told else {}  # fmt: skip


def smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """Running means of ``[runs, episodes]`` over what is known, NaN where nothing is; a run keeps
    its last one after its end.
    """
    known, numbers = np.isfinite(values), np.arange(values.shape[1])
    with np.errstate(invalid="ignore"):
        means = running_mean(np.where(known, values, 0), window) / running_mean(
            known.astype(float), window
        )
    means = np.maximum(means, np.where(known, values, np.inf).min(1, keepdims=True))  # but rounding
    ends = values.shape[1] - 1 - known[:, ::-1].argmax(1)
    return np.take_along_axis(means, np.minimum(numbers, ends[:, None]), axis=1)


def _orders(arms: Mapping[int, np.ndarray]) -> bool:
    """Whether a measure is drawn by its logarithm, by its smoothed values."""
    every = _known(arms.values())
    return bool(every.size and 0 < LOGARITHMIC * every.min() < every.max())


def _lines(values: np.ndarray, at: np.ndarray, runs: int, orders: bool) -> np.ndarray:
    """At episodes ``at`` the mean of smoothed ``[runs, episodes]``, the ends of what is shaded
    around it, and so many single runs, ``[3 + runs, points]``.
    """
    known = values[np.isfinite(values).any(1)]
    known = known if len(known) else values
    every = [known.mean(0), *plots.around(known, positive=orders), *values[:runs]]
    return np.stack(every)[:, at[at <= values.shape[1]] - 1]


def _heights(
    name: str, lines: Mapping[int, np.ndarray], orders: bool, solved: float | None
) -> tuple[Mapping[str, Any], bytes] | None:
    """What is told of a measure, and its lines, arm by arm, as heights between the lowest and the
    highest value, -1 where there is none, each as the differences from point to point; None where
    nothing varies. What is shaded may reach beyond single runs, and is cut off there.
    """
    told = _known(np.delete(one, (1, 2), axis=0) for one in lines.values())
    if not told.size or not np.ptp(told):
        return None
    shaded = _known(one[1:] for one in lines.values() if len(one) == 3)
    told = np.concatenate([told, shaded, [] if solved is None else [solved]])
    ends = told.min(), told.max()
    scale = np.log if orders else np.asarray
    (low, high), packed = scale(np.array(ends)), b""
    for one in lines.values():
        shares = (scale(np.clip(one, *ends)) - low) / (high - low)
        heights = np.where(np.isfinite(shares), np.rint(HEIGHTS * shares), -1)
        packed += np.diff(heights, prepend=0, axis=1).astype("<i2").tobytes()
    arms = [[number, one.shape[1], len(one) - 3] for number, one in lines.items()]
    said = {"name": name.replace("_", " "), "lowest": float(ends[0]), "highest": float(ends[1])}
    return said | {"orders": orders, "arms": arms, "solved": solved}, packed


def _known(parts: Iterable[np.ndarray]) -> np.ndarray:
    """All that is finite in them, ``[values]``."""
    every = np.concatenate([np.empty(0), *map(np.ravel, parts)])
    return every[np.isfinite(every)]

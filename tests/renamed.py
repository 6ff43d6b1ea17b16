"""Names that changed after 30aa21d, old to new: modules, flags, settings, arms, arrays.

A record keeps the command that was typed; `respelled` says how it is typed today.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from typing import Any

MODULES: dict[str, tuple[str, ...] | None] = {
    "cartpole_readings": ("cartpole", "--part", "readings"),
    "cartpole_levers": ("cartpole", "--part", "levers"),
    "cartpole_accuracy": ("cartpole", "--part", "accuracy"),
    "cartpole_data": ("cartpole", "--part", "data"),
    "maze_levers": ("maze", "--part", "levers"),
    "cartpole_scaling": ("benchmark", "--what", "sweeps", "--sizes", "10", "100", "1000"),
    "maze_bench": None,
    "pong_likeness": None,
}
"""None: cut, with its record."""

PARTS = {"model": "frames", "train": None}
"""None: the default, which no longer has a name."""

DYNA = {
    "real_first": "dyna.num_real_first",
    "model_updates": "dyna.model_updates",
    "model_batch": "dyna.model_batch",
    "dream_updates": "dyna.dream_updates",
    "dream_episodes": "dyna.dream_episodes",
    "dream_steps": "dyna.dream_steps",
    "replay_capacity": "dyna.replay_capacity",
    "terminal_share": "dyna.rare_share",
    "rare_share": "dyna.rare_share",
    "hparams.termination_threshold": "hparams.dream.termination_threshold",
    "hparams.disagreement_threshold": "hparams.dream.uncertainty_threshold",
    "dyna.rest_when_safe": "rest_when_safe",
    "dyna.forget_every": "forget_every",
}
SETTINGS = dict.fromkeys(("cartpole", "maze", "pong", "catch", "planning"), DYNA)
"""By module as `respelled`, with its part where it has one: dotted paths."""

VALUES = {
    "preset": {"paper": "tuned"},
    "arms": {"dyna (paper preset)": "dyna (tuned preset)"},
    "pong arms": {"more_updates": "max_updates"},
}
"""By setting, or by module and setting."""

NOT_SETTINGS = ("part", "out", "resume")
"""In the settings of old records, and today what the call says beside them."""

DECIDED = {
    "* hparams.env.max_steps": "--steps decides it, and today's record says how",
    "pong hparams.env.points_to_win": "none, since an episode is so many steps",
    "pong hparams.env.*serve_delay": "--serve-delay decided it, and said 5 as they do today",
    "pong serve_delay": "cut: --hparams.env.serve-delay says it",
    "maze *rest_when_safe": "cut: no episode there ends in a fall",
    "pong *rest_when_safe": "cut: likewise",
    "catch *rest_when_safe": "cut: likewise",
    "maze *forget_every": "cut: the replay is the agent's",
    "pong *forget_every": "cut: likewise",
    "catch *forget_every": "cut: likewise",
    "pong look": "cut: each object's places, but what convolutions see where --frames is rgb",
    "pong glimpse": "cut with the glimpses, which no record has",
    "pong frame_skip": "cut: always 4",
    "pong patch": "cut: always 4",
    "pong kernels": "cut: always 4, 3 and 3",
    "planning contenders": "no setting today; five are no longer played, as the lab book says",
    "maze mpc.discount": "the agent's",
    "maze mcts.discount": "the agent's",
    "maze cloning.capacity": "as many steps as --shown-episodes have",
    "maze cloning.updates": "as many as dyna makes on dreams",
    "maze cloning.l*": "the arm's own, which are the setting's default today",
    "maze reward": "own, as every model has it today: the option was cut",
    "benchmark episodes": "--sweep-episodes says it",
    "benchmark preset": "it was lean; tuned alone is measured today",
    "cartpole block": "None was all runs together; a number decides a run's bits today",
}
"""Recorded settings that were not those in use, mean another thing or were cut, by module and
pattern of the path, and why."""

REMADE = {
    "cartpole lean": (
        "dyna.model_updates",
        "dyna.dream_updates",
        "model.ensemble",
        "hparams.agent.learning_rate",
        "episodes",  # of the levers, and:
        "stop_after_solved",
    ),
    "maze lean": (
        "dyna.num_real_first",
        "dyna.model_updates",
        "dyna.dream_updates",
        "agent.fake_capacity",
        "hparams.agent.epsilon_hold",
        "hparams.agent.epsilon_episodes",
    ),
}
"""Settings that a preset sets otherwise since its records were made, by module and preset."""

ARRAYS: dict[str, str | None] = {
    "oracle_return": "optimal_return",
    "judged_error": None,  # in results.json, out of the curve that it is a mean of
    **dict.fromkeys(("film_action", "film_obstacles", "film_directions")),  # of the Maze's films
}
"""In ``curves.npz``; None: no longer kept."""

JUDGED = (
    "held_out_*", "example_*", "greedy_*", "game_*", "cost_*", "film_greedy", "film_truth",
    "film_dream", "one_step", "mass", "reward", "dream*", "still_unserved", "seen", "truth",
    "belief", "decisions: *",
)  # fmt: skip
"""Arrays of what is judged after training, from keys of its own and perhaps by other names."""

LOSSES = ("*loss*", "*error*", "state_*", "change_*", "judged_*")
"""Arrays of numbers that rounding moves a little; all others come of actions."""


def respelled(command: Sequence[str]) -> list[str] | None:
    """A module and its flags as they are typed today; None where it was cut."""
    module, groups = command[0], list(_groups(command[1:]))
    start = MODULES.get(module, (module,))
    if start is None:
        return None
    said = {path: values for _, path, values in groups}
    part = said.get("part", [""])[-1]
    if "part" in said and PARTS.get(part, part) is not None:
        start = (*start, "--part", PARTS.get(part) or part)
    words = [*start]
    for no, path, values in groups:
        if path != "part":
            flag = _setting(start, path).replace("_", "-")
            table, dot, name = flag.rpartition(".")
            words += [
                f"--{table}{dot}{no}{name}",
                *(_value(start[0], path, value) for value in values),
            ]
    return words


def respelled_settings(command: Sequence[str], config: Mapping[str, Any]) -> dict[str, Any]:
    """A record's settings by their dotted paths of today, without those that were not in use."""
    start = respelled(command) or [""]
    settings, remade = {}, REMADE.get(f"{start[0]} {config.get('preset')}", ())
    for path, value in _flat(config):
        skipped = path in NOT_SETTINGS or _setting(start, path) in remade
        if not skipped and not is_one(f"{start[0]} {path}", DECIDED):
            listed = isinstance(value, list)
            items = [_value(start[0], path, item) for item in (value if listed else [value])]
            settings[_setting(start, path)] = items if listed else items[0]
    return settings


def arm_of(module: str, arm: str) -> str:
    """An arm's name of today."""
    return _value(module, "arms", arm)


def arrays(name: str) -> list[str]:
    """The names that an array may have today; what is kept of the first run alone has ``show_`` in
    front. None where it is no longer kept.
    """
    today = ARRAYS.get(name, name)
    if today is None:
        return []
    bare = today.removeprefix("film_").removeprefix("example_")
    return [today, f"show_{today}", f"show_{bare}"]


def is_one(name: str, patterns: Iterable[str]) -> bool:
    """Whether a name fits one of the patterns."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def _groups(words: Sequence[str]) -> Iterator[tuple[str, str, list[str]]]:
    """``("no-" or "", dotted path, values)`` of each flag."""
    groups: list[tuple[str, str, list[str]]] = []
    for word in words:
        if not word.startswith("--"):
            groups[-1][2].append(word)
            continue
        flag, equals, value = word.removeprefix("--").partition("=")
        table, dot, name = flag.replace("-", "_").rpartition(".")
        bare = name.removeprefix("no_")
        no = "no-" if bare != name else ""
        groups.append((no, f"{table}{dot}{bare}", [value] if equals else []))
    yield from groups


def _setting(start: Sequence[str], path: str) -> str:
    """A setting's path of today in a command that starts so."""
    part = start[2] if "--part" in start[1:2] else ""
    return SETTINGS.get(f"{start[0]} {part}".strip(), {}).get(path, path)


def _value(module: str, path: str, value: Any) -> Any:
    renamed = VALUES.get(path, {}) | VALUES.get(f"{module} {path}", {})
    return renamed.get(value, value) if isinstance(value, str) else value


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

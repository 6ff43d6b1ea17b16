"""Checks of anybody's own parts, in the manner of Gymnasium's ``check_env``: each runs a part on
small inputs, and raises a `ContractError` that says what is wrong first, and how to mend it.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxdyna.actions import Actions, Box, Discrete, actions_in, actions_of, as_actions
from jaxdyna.planners import Guide, Planner
from jaxdyna.trees import difference, is_key, named_leaves, stack
from jaxdyna.types import Agent, DynamicsModel, Environment, Transition, check_part

ROWS, STEPS = 4, 50
"""Calls that are compared with one another, and steps of an episode at the most."""
BRANCHES = "branches in Python on a traced value: choose by jnp.where or jax.lax.cond"
ERRORS: dict[type[Exception], str] = {
    jax.errors.KeyReuseError: "uses a random key twice: split it by jax.random.split",
    jax.errors.TracerBoolConversionError: BRANCHES,
    jax.errors.JAXTypeError: "makes a Python number of a traced value: compute by jax.numpy",
}
"""What errors of JAX mean, the first that fits."""
PADDING = (
    "depends on the padding, masked steps after the end: weigh steps by transitions.weights, "
    "divide by their sum, and let sums over what follows end where an episode ends"
)
EPISODES = "transitions have not the axes of episodes: give those of a rollout, [N, T]"
AXES = "depends on how many leading axes transitions have: flatten as many as the mask has"


class ContractError(AssertionError):
    """A part does not do what `jaxdyna.types` says."""


def check_environment(env: Environment, params: Any = None, random: bool | None = None) -> None:
    """Plays a few episodes of random actions; ``params`` are by default ``env.default_params``.
    ``random`` demands that the key matters; without it nothing need be random.
    """
    check_part("env", env, "reset", "step", "default_params", "action_space")
    name = type(env).__name__
    try:
        hash(env)
    except TypeError as error:
        raise ContractError(f"{name} is not hashable: make it a frozen dataclass") from error
    params = env.default_params if params is None else params
    space, choices = env.observation_space(params), actions_of(env)
    agree = actions_in(env.action_space(params)) == choices
    _demand(agree, f"{name}'s num_actions and action_space differ: make the two agree")
    _demand(hasattr(params, "max_steps"), f"{name}'s params have no max_steps: add that field")
    reset = _Pure(f"{name}.reset", env.reset, (0, None))
    step = _Pure(f"{name}.step", env.step, (0, 0, 0, None))
    starts = reset.check([(key, params) for key in _keys(0)], "obs, state")
    actions = _actions(choices)
    columns = zip(_keys(1), starts, actions[0], strict=True)
    calls = [(key, start[1], action, params) for key, start, action in columns]
    steps = step.check(calls, "obs, state, reward, terminated, truncated, info")
    (obs, state), (next_obs, next_state, *numbers, _) = starts[0], steps[0]
    like = np.zeros(space.shape, space.dtype)
    _alike(f"{reset.name}'s observation", obs, like, "the observation_space")
    _alike(f"{step.name}'s observation", next_obs, like, "the observation_space")
    _alike(f"{step.name}'s state", next_state, state, "the state before it")
    kinds = (("reward", np.floating), ("terminated", np.bool_), ("truncated", np.bool_))
    for number, (what, kind) in zip(numbers, kinds, strict=True):
        _scalars(f"{step.name}'s {what}", [number], kind)
    step(_keys(2)[0], next_state, actions[0, 0], params)
    if isinstance(choices, Box):
        low, high = np.array([choices.low, choices.high], np.float32)
        wrong = f"{step.name} takes an action beyond its action_space for another: clip it"
        for end, beyond in ((low, low - 9), (high, high + 9)):
            far, near = (step(_keys(2)[0], state, action, params) for action in (beyond, end))
            _same(far, near, wrong, 1e-6)
    ended, *_ = _play(reset, step, space, params, actions)
    change = getattr(params, "replace", None) or params._replace
    last = ended or STEPS  # the step that terminates is now the last one too
    *_, alive = _play(reset, step, space, change(max_steps=last), actions[:last])
    wrong = f"{step.name} goes on after params.max_steps: count steps in the state, and return"
    _demand(not alive.any(), f"{wrong} truncated = ~terminated & (time >= params.max_steps)")
    if random:
        _, seen, _ = _play(reset, step, space, params, actions[:, :1].repeat(ROWS, 1))
        differ = any((rows != rows[0]).any() for rows in seen)
        _demand(differ, f"the seed changes nothing in {name}: draw from the key of reset or step")


def check_agent(
    agent: Agent, hparams: Any, transitions: Transition, num_actions: int | Actions
) -> None:
    """Acts on a few observations and learns from a few whole episodes ``[N, T]``, T at least 2."""
    check_part("agent", agent, "init", "act", "update")
    _demand(np.ndim(transitions.mask) == 2, EPISODES)
    state = _Pure("init", agent.init)(_keys(0)[0], hparams)
    obs = np.asarray(transitions.obs)[0]
    for name in ("act", "act_fake", "act_greedy"):
        if act := getattr(agent, name):
            calls = [(state, *row, hparams) for row in zip(obs, _keys(1), strict=False)]
            actions = _Pure(name, act, (None, 0, 0, None)).check(calls)
            _allowed(f"{name}'s action", actions, as_actions(num_actions))
    for name in ("update", "update_fake", "update_expert"):
        if update := getattr(agent, name):
            _check_update(name, update, state, hparams, transitions, PADDING)


def check_model(model: DynamicsModel, hparams: Any, transitions: Transition) -> None:
    """Predicts a few transitions and learns from a few whole episodes ``[N, T]``, T at least 2."""
    check_part("model", model, "init", "predict", "update")
    _demand(np.ndim(transitions.mask) == 2, EPISODES)
    state = _Pure("init", model.init)(_keys(0)[0], hparams)
    _demand(hasattr(state, "params"), "init's state has no params: call what predict takes so")
    obs, action = np.asarray(transitions.obs)[0], np.asarray(transitions.action)[0]
    calls = [(state.params, *row) for row in zip(obs, action, _keys(1), strict=False)]
    predict = _Pure("predict", model.predict, (None, 0, 0, 0))
    said = predict.check(calls, "next_obs, reward, terminated, uncertainty", small=False)
    next_obs, reward, terminated, uncertainty = zip(*said, strict=True)
    _alike("predict's next_obs", next_obs[0], obs[0], "the observation before it")
    _scalars("predict's reward", reward, np.floating)
    _scalars("predict's terminated, a probability,", terminated, np.floating, 0, 1)
    _scalars("predict's uncertainty", uncertainty, np.floating, 0)
    _check_update("update", model.update, state, hparams, transitions, AXES)


def check_planner(planner: Planner, env: Environment, params: Any, prior: bool = False) -> None:
    """Decides in a few first states of the environment that it plans in, at best a tiny one.
    ``prior`` says whether ``guide.prior`` has to count, as where it starts from a policy.
    """
    check_part("planner", planner, "__call__")
    name, reset, kind = "the planner", jax.jit(env.reset), actions_of(env)
    zeros = np.zeros(kind.outputs[0], np.float32)
    starts = [(*reset(key, params), key) for key in _keys(0)]

    def plan(params: Any, obs: Any, state: Any, key: Any, odds: Any, value: Any) -> Any:
        guide = Guide(lambda obs: odds, lambda obs, state, key: value)
        return planner(params, obs, state, key, guide)

    def guided(odds: Any, value: float) -> list[tuple]:
        return [(params, *start, odds, np.float32(value)) for start in starts]

    deciding = _Pure(name, plan, (None, 0, 0, 0, None, None))
    said = deciding.check(guided(zeros, 0), "action, value", small=False)
    action, value = zip(*said, strict=True)
    _allowed(f"{name}'s action", action, kind)
    _scalars(f"{name}'s value", value, np.floating)
    hoped = [deciding(*call)[1] for call in guided(zeros, 1000)]
    counts = any(map(np.not_equal, value, hoped))
    _demand(counts, f"{name} ignores its guide: add guide.value of where it stops looking")
    if prior:
        odds = 100 * np.eye(len(zeros), dtype=np.float32)
        chosen = {int(deciding(*call)[0]) for row in odds for call in guided(row, 0)}
        _demand(len(chosen) > 1, f"{name} ignores its guide: start from the log odds guide.prior")


class _Pure:
    """A function that ought to be pure; over a batch by ``axes`` as ``jax.vmap`` takes them."""

    def __init__(self, name: str, function: Callable, axes: tuple = (0,)) -> None:
        self.name, self.function, self.axes, self.traces = name, function, axes, 0
        self.jitted, self.batched = jax.jit(self._traced), jax.jit(jax.vmap(function, axes))

    def _traced(self, *args: Any) -> Any:
        self.traces += 1
        return self.function(*args)

    def run(self, function: Callable, *args: Any) -> Any:
        """The function, or a form of it; a batched cond is no two uses of a key."""
        try:
            with jax.debug_key_reuse(function is self.jitted):
                return function(*args)
        except tuple(ERRORS) as error:
            meaning = next(text for kind, text in ERRORS.items() if isinstance(error, kind))
            raise ContractError(f"{self.name} {meaning}") from error

    def __call__(self, *args: Any) -> Any:
        """A result, compiled once for all arguments of these shapes; their keys stay unused."""
        fresh = jax.tree.map(lambda leaf: jax.random.clone(leaf) if is_key(leaf) else leaf, args)
        result = self.run(self.jitted, *fresh)
        anew = f"{self.name} is compiled anew (retracing) for another state of the same shape"
        _demand(self.traces == 1, f"{anew}: begin with types, jnp.float32(0) instead of 0.0")
        return result

    def check(self, calls: list[tuple], returns: str = "", small: bool = True) -> list[Any]:
        """The results of the calls: the same as a batch and, of a small function, eager. A batch is
        traced anew, so that it differs as well where something is not pure.
        """
        results, count = [self(*call) for call in calls], len(returns.split(", "))
        whole = not returns or (isinstance(results[0], tuple) and len(results[0]) == count)
        _demand(whole, f"{self.name} does not return {count} values: return {returns}")
        wrong = f"{self.name} differs under jit: draw from its key, and keep the rest in arguments"
        if small:
            _same(self.run(self.function, *calls[0]), results[0], wrong, 1e-3)
        columns = zip(self.axes, zip(*calls, strict=True), strict=True)
        batch = [column[0] if axis is None else stack(column) for axis, column in columns]
        together, apart = self.run(self.batched, *batch), stack(results)
        if not small and difference(together, apart, 1e-3):
            _same(self.run(jax.jit(self.function), *calls[0]), results[0], wrong, 1e-3)
        wrong = f"{self.name} differs under vmap: compute along a call's own axes, and give a"
        _same(together, apart, f"{wrong} callback the vmap_method that fits", 1e-3)
        return results


def _play(
    reset: _Pure, step: _Pure, space: Any, params: Any, actions: Any
) -> tuple[int, list, np.ndarray]:
    """Judges episodes under actions ``[T, N]``, each up to its end: after how many steps the first
    one terminated (0: none), what there was to see, ``[N, ...]`` each, and which have not ended.
    """
    obs, state = reset.run(reset.batched, stack(_keys(3)), params)
    alive, ended, seen = np.ones(ROWS, bool), 0, []
    reward = terminated = truncated = np.zeros(ROWS, bool)
    for time in range(len(actions) + 1):
        if time:
            inputs = (stack(_keys(3 + time)), state, actions[time - 1], params)
            obs, state, *rest, _ = step.run(step.batched, *inputs)
            reward, terminated, truncated = map(np.asarray, rest)
        rows, at = np.asarray(obs)[alive], f"at step {time}"
        said, inside = f"{step.name}'s", all(map(space.contains, rows))
        wrong = f"observation is outside its space {at}, from {rows.min()} to {rows.max()}"
        _demand(inside, f"{said} (or reset's) {wrong}: clip it, or widen the observation_space")
        finite, both = np.isfinite(reward[alive]), terminated & truncated & alive
        _demand(finite.all(), f"{said} reward is NaN or infinite {at}: never divide by 0")
        wrong = f"{said} terminated and truncated are true at once {at}"
        _demand(not both.any(), f"{wrong}: return truncated & ~terminated")
        seen += [rows, reward[alive], terminated[alive]]
        ended = ended or time * int((terminated & alive).any())
        alive = alive & ~(terminated | truncated)
        if not alive.any():
            break
    return ended, seen, alive


def _check_update(
    name: str, update: Callable, state: Any, hparams: Any, episodes: Transition, form: str
) -> None:
    """What agents and models owe alike; transitions take another form too (`PADDING`, `AXES`)."""
    learning, key = _Pure(name, update, (0, None, 0, None)), _keys(1)[0]
    ones, half = np.ones(episodes.mask.shape, np.float32), episodes.mask.shape[1] // 2
    full = jax.tree.map(np.asarray, episodes)._replace(weight=ones)
    early = full.mask & (np.arange(ones.shape[1]) < half)
    answer = learning(state, full, _keys(0)[0], hparams)
    whole = isinstance(answer, tuple) and len(answer) == 2 and "loss" in answer[1]
    _demand(whole, f'{name} does not return a loss: return state, {{"loss": loss}}')
    new, metrics = answer
    _alike(f"{name}'s state", new, state, "the state before it")
    _scalars(f"{name}'s loss", [metrics["loss"]], np.floating)
    worse = full._replace(reward=-1 - full.reward)
    moved = difference(new, state) or difference(learning(state, worse, key, hparams)[0], state)
    _demand(moved, f"{name} learns nothing, it returns the state that it got: return the new one")
    finite = all(np.isfinite(leaf).all() for leaf in named_leaves(new).values())
    _demand(finite, f"{name}'s state is NaN: keep gradients finite, as that of sqrt at 0 is not")

    def spoilt(leaf: np.ndarray) -> np.ndarray:
        worst = {"f": np.nan, "b": True, "u": 255, "i": leaf.max()}[leaf.dtype.kind]
        exists = early.reshape(early.shape + (1,) * (leaf.ndim - early.ndim))
        return np.where(exists, leaf, np.full_like(leaf, worst))

    def reshaped(leaf: np.ndarray) -> np.ndarray:
        return leaf[:, :half] if form == PADDING else leaf.reshape(-1, *leaf.shape[2:])

    def learned(transitions: Transition) -> Any:
        return learning(new, transitions, key, hparams)

    cut, none = full._replace(mask=early), full._replace(mask=early & False)
    some, idle = learned(cut), learned(full._replace(weight=0 * ones))[0]
    wrong = f"{name} learns from masked steps: take transitions.blanked(), as NaN * 0 is NaN"
    _same(learned(jax.tree.map(spoilt, full)._replace(mask=early)), some, wrong)
    wrong = f"{name} changes the state though every step is masked: choose the old by jnp.where"
    _same(learned(none)[0], new, wrong)
    wrong = f"{name} ignores the weight, it learns where that is 0: use transitions.weights"
    _same(_learned(idle), _learned(new), f"{wrong}, and keep the state where all are 0")
    other, keys = jax.tree.map(reshaped, cut), stack([key, key])
    both = learning.run(learning.batched, stack([new, new]), other, keys, hparams)
    if _far(both, stack([some, some])):
        alone = _Pure(name, update)(new, other, key, hparams)
        _demand(not _far(alone, some), f"{name} {form}")
        raise ContractError(f"{name} differs under vmap: compute along a run's own axes")


def _learned(state: Any) -> np.ndarray:
    """Numbers ``[n]`` in fields called params, without such fields all."""
    rows = [(path, leaf.ravel()) for path, leaf in named_leaves(state).items()]
    return np.concatenate([row for path, row in rows if ".params" in path] or [x for _, x in rows])


def _far(one: tuple, other: tuple) -> bool:
    """Whether losses differ, or a tenth of what is learned: Adam makes steps of rounding errors."""
    near = np.isclose(_learned(one[0]), _learned(other[0]), 1e-3, 1e-3)
    return near.mean() < 0.9 or bool(difference(one[1]["loss"], other[1]["loss"], 1e-3))


def _demand(holds: Any, message: str) -> None:
    if not holds:
        raise ContractError(message)


def _actions(kind: Actions) -> np.ndarray:
    """Any, ``[STEPS, ROWS, ...]``."""
    generator = np.random.default_rng(0)
    if isinstance(kind, Discrete):
        return generator.integers(0, kind.n, (STEPS, ROWS), np.int32)
    return generator.uniform(kind.low, kind.high, (STEPS, ROWS, *kind.shape)).astype(np.float32)


def _allowed(name: str, actions: Any, kind: Actions) -> None:
    """Demands actions of a kind: numbers in their range, or vectors, within bounds or not."""
    if isinstance(kind, Discrete):
        return _scalars(name, actions, np.integer, 0, kind.n - 1)
    for action in actions:
        _alike(name, action, np.zeros(kind.shape, kind.dtype), "the action_space")
        _scalars(name, action, np.floating)


def _keys(seed: int) -> list[jax.Array]:
    return [jax.random.key(ROWS * seed + row) for row in range(ROWS)]


def _same(one: Any, other: Any, message: str, tolerance: float = 0) -> None:
    wrong = difference(one, other, tolerance)
    _demand(not wrong, f"{message} ({wrong})")


def _alike(name: str, value: Any, like: Any, what: str) -> None:
    """Demands the same structure, shapes and types, as ``jax.lax.scan`` does."""
    new, old = named_leaves(value), named_leaves(like)
    same = new.keys() == old.keys()
    _demand(same, f"{name} has another structure than {what}: return the same pytree")
    for path, leaf in new.items():
        is_now, was = (f"{x.dtype}{list(x.shape)}" for x in (leaf, old[path]))
        wrong = f"{name}{path} is {is_now}, unlike {what}, {was}"
        _demand(is_now == was, f"{wrong}: keep shape and dtype, by reshape and astype")


def _scalars(name: str, values: Any, kind: Any, low: float = -np.inf, high: float = np.inf) -> None:
    """Demands scalars of a kind, finite and in a range."""
    for value in map(np.asarray, values):
        right = value.shape == () and np.issubdtype(value.dtype, kind)
        wrong = f"{name} is {value.dtype} of shape {value.shape}"
        _demand(right, f"{wrong}: return a scalar, {kind.__name__}, by reshape or astype")
        inside = np.isfinite(value) and low <= value <= high
        _demand(inside, f"{name} is {value}: keep it finite and within [{low}, {high}]")

"""The benchmark: how it times, and what it measures at its smallest, without PyTorch."""

import json
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maze_numpy import PlainMaze

from jaxdyna.agents import reinforce
from jaxdyna.envs import CartPole, Maze
from jaxdyna.experiments.benchmark import (
    PARTS,
    BenchmarkOptions,
    commands,
    dreams,
    frames,
    others,
    report,
    steps,
    timing,
    whole,
)  # fmt: skip
from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import InputError, Record, main
from jaxdyna.models import supervised
from jaxdyna.types import Transition

RECORD = "experiments/cartpole_tuned/results.json"
PROG = "python -m jaxdyna.experiments.benchmark"
TINY = BenchmarkOptions(rounds=1, envs=3, batches=(2,))


@pytest.fixture
def alone(monkeypatch):
    """Without any rival of PyTorch's, and with turns of one call."""
    monkeypatch.setattr(timing.in_turns, "__defaults__", (0.0, timing.time.perf_counter))
    monkeypatch.setattr(timing, "PRODUCTS", {"one": (1, 4, 4)})
    for module in (dreams, frames, whole):
        monkeypatch.setattr(module, "rival", lambda name: None)


def test_works_are_timed_in_turns():
    """``a`` takes 1 second a call, ``b`` 4 for its two units; a turn lasts 3 seconds or more."""
    called, now = [], [0.0]

    def work(name, seconds, units):
        def call():
            called.append(name)
            now[0] += seconds
            return units

        return call

    works = {"a": work("a", 1, 1), "b": work("b", 4, 2), "none": None}
    seconds = timing.in_turns(works, 2, least_s=3.0, clock=lambda: now[0])
    assert "".join(called) == "aa" + "bb" + 2 * "aaab"
    assert {name: each.tolist() for name, each in seconds.items()} == {"a": [1, 1], "b": [2, 2]}


def test_a_row_has_medians_and_the_ratios_of_turns():
    row = timing.row("x", "steps/s", np.array([1.0, 2.0, 4.0]), "other", np.array([3.0, 2.0, 40.0]))
    assert (row["ours"], row["theirs"]) == (0.5, 1 / 3)
    assert row["ratio"] == 3 and row["ends"] == [1, 10]
    assert report.line(row) == "x: 0.5 steps/s; other: 0.333 steps/s; ratio 3 (1 to 10)"
    assert timing.row("x", "ms", 0.2, "other") == {
        "what": "x", "unit": "ms", "ours": 200, "whose": "other", "theirs": None,
    }  # fmt: skip
    assert timing.row("x", "steps/s", 0.5, "other", ceiling=8.0)["share"] == 0.25


def starts(*shape: int):
    """Of CartPole's episodes, of that shape."""
    reset, keys = jax.vmap(CartPole().reset, (0, None)), jax.random.split(jax.random.key(1), shape)
    return jax.vmap(lambda keys: reset(keys, CartPole().default_params))(keys)


def test_given_actions_play_without_an_end():
    pushes = np.tile(steps.PUSHES[:, None], (1, 4096))
    (obs, state), (reward, terminated, truncated) = steps.given(
        CartPole(), jax.random.key(0), starts(2, 4096), pushes
    )
    assert obs.shape == (2, 4096, 4) and reward.shape == (2, steps.STEPS, 4096)
    assert (state.time == steps.STEPS).all() and not (terminated | truncated).any()
    np.testing.assert_array_equal(obs[..., 2], state.theta)


def test_no_pole_falls_before_the_shortest_episode_is_over():
    """From the corners of what starts are drawn from, always pushed the same way."""
    env, ends = CartPole(), np.array(list(np.ndindex(2, 2, 2, 2)), np.float32) * 0.1 - 0.05
    pushes = np.ones((steps.SHORTEST, len(ends)), int)
    start = (jnp.asarray(ends)[None], jax.vmap(jax.vmap(env.state_of))(jnp.asarray(ends)[None]))
    for way in (pushes, 1 - pushes):
        _, (_, terminated, _) = steps.given(env, jax.random.key(0), start, way)
        assert not terminated[:, :-1].any()


def test_what_is_over_is_reset():
    (obs, state), (reward, terminated, _) = steps.at_random(CartPole(), 512, jax.random.key(0))
    last = np.array([np.flatnonzero(lane)[-1] if lane.any() else -1 for lane in terminated.T])
    assert (last >= 0).sum() > 100 and reward.all()
    assert (state.time == steps.STEPS - 1 - last).all()
    assert abs(obs[last == steps.STEPS - 1]).max() <= 0.05


def test_the_numpy_maze_plays_by_the_rules():
    plain = others.rival("numpy_maze").NumpyMaze(seed=1, size=6, obstacles=3, steps=40)
    frame, rng = plain.reset(), np.random.default_rng(0)
    known = PlainMaze(6, plain.agent, plain.goal, plain.obstacles, plain.directions, 40)
    for action in rng.integers(5, size=40):
        assert (frame == known.frame()).all()
        frame, *played = plain.step(action)
        assert tuple(played) == known.step(action)
    assert Maze(6, 3).num_actions == plain.num_actions


def test_work_is_counted_up_to_each_runs_own_end():
    nan = np.nan
    curves = {"real_length": np.array([[2.0, 3.0, 5.0, nan], [1.0, 1.0, 1.0, 1.0]]),
              "fake_length": np.array([[nan, 3.0, 4.0, nan], [nan, 1.0, 1.0, 1.0]])}  # fmt: skip
    arm = {"episodes_to_solve": {"per_seed": [None, -98]}}  # 100 on, two count
    assert whole.counted(arm, curves) == (12.0, 5 * 60, 16 * (3 + 4 + 1))
    assert whole.counted(arm, {"real_length": curves["real_length"]}) == (12.0, 0, 0)


def test_a_whole_result_stands_beside_the_same_work(monkeypatch):
    """Two runs that took 8 seconds, of 10 steps, beside pieces that take so many seconds each."""
    arm = {"episodes_to_solve": {"per_seed": [None]}}
    curves = {"real_length": np.array([[10.0]]), "fake_length": np.array([[2.0]])}
    played = others.Ran(8.0, 0), {"arms": {"dyna": arm}}, {"dyna": curves}
    monkeypatch.setattr(whole, "played", lambda *words: played)
    monkeypatch.setattr(whole, "pieces", lambda *_: dict.fromkeys(
        (whole.REAL, whole.MODEL, whole.FAKE, whole.TOGETHER), lambda: 1.0))  # fmt: skip
    seconds = dict(zip(whole.pieces(), ([1.0], [0.1], [0.5], [0.25]), strict=True))
    monkeypatch.setattr(whole, "in_turns", lambda works, rounds: seconds)
    monkeypatch.setattr(whole.storage, "cores", lambda: 2)
    written, batched, *pieces = whole.measure(replace(TINY, runs=(2,)))
    assert written["ours"] == 8 and written["theirs"] == (10 + 6 + 16) / 2
    assert batched["ratio"] == (10 + 6 + 8) / 2 / 8 and len(pieces) == 4


def test_a_process_is_measured_and_its_failure_is_one_line():
    small, large = (others.command("-c", f"bytearray({size})") for size in (1, 2**28))
    assert 2**27 < large.peak_bytes - small.peak_bytes < 2**29 and small.seconds > 0
    assert small.peak_bytes < 2**27, "not the peak of the process that measures"
    with pytest.raises(InputError, match=r"ended with code 1: ZeroDivisionError"):
        others.command("-c", "1 / 0")


def test_costs_starts_and_memory_are_of_the_commands(monkeypatch):
    def played(world, *flags, cache=None):
        count = int(flags[flags.index("--seeds") + 1])
        timing = {"compile_s": 4.0 if cache else 6.0, "run_s": 2.0 * count}
        return others.Ran(9.0, 2**30), {"timing": timing}, {}

    monkeypatch.setattr(commands, "played", played)
    monkeypatch.setattr(commands, "command", lambda *words: others.Ran(1.0, 2**29))
    rows = list(commands.sweeps(replace(TINY, sizes=(1, 3))))
    assert [row["ours"] for row in rows] == [8, 2, 4, 2] and rows[2]["ratio"] == 2
    assert [row["what"] for row in commands.start(TINY)][-1] == "second start, result and report"
    nothing, cartpole, _ = commands.memory(replace(TINY, worlds=("Maze",)))
    assert nothing["theirs"] == 0.5 and 0.001 < cartpole["ours"] < 0.02 and cartpole["theirs"] == 1


def test_a_report_is_made_of_what_was_measured(alone, tmp_path):
    words = ["--what", "steps", "dreams", "--rounds", "1", "--envs", "2", "--batches", "2"]
    assert main(*PARTS, argv=[*words, "--out", str(tmp_path)], prog=PROG) == 0
    results, text = (tmp_path / name for name in ("results.json", "report.md"))
    found = json.loads(results.read_text())
    rows = found["steps"]["rows"] + found["dreams"]["rows"]
    assert [row["whose"] for row in rows] == [
        "Gymnasium",
        "Gymnasium",
        "NumPy, one core",
        "PyTorch",
    ]
    assert all(row["ratio"] > 0 for row in rows[:3]) and found["whole"] is None
    assert rows[3]["theirs"] is None and rows[3]["share"] > 0
    assert set(found["dreams"]["yardstick"]) == {"one"}
    assert "pip install 'jaxdyna[bench]'" in text.read_text() and (tmp_path / "ratios.png").exists()
    again = Record(replace(TINY), found, {}, tmp_path)
    assert report.section(again, "dreams") in text.read_text() and not report.section(
        again, "whole"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sizes", "0"], "--sizes is (0,)"), (["--seeds", "3"], "decided"),
        (["--sizes"], "empty"), (["--what", "all"], "--what is ('all',)"),
        (["--shard", "1/2"], "benchmark has none"), (["--sweep", "envs=2,4"], "benchmark has none"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(*PARTS, argv=arguments, prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1


@pytest.mark.parametrize(
    ("python", "complaint"),
    [("no/python", "that is no program, name a Python"), (sys.executable, "install gymnax there")],
)
def test_an_interpreter_without_gymnax_is_one_line(python, complaint, alone, capsys, tmp_path):
    words = ["--what", "steps", "--rounds", "1", "--envs", "2", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as stop:
        main(*PARTS, argv=[*words, "--gymnax", python], prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and complaint in said and said.count("\n") == 1


@pytest.mark.slow
def test_frames_are_measured(alone):
    rows = list(frames.measure(replace(TINY, worlds=("Maze",))))
    assert [row["what"].split(", ")[1] for row in rows] == [
        "model update", "DQN update", "whole episode"
    ]  # fmt: skip
    assert all(row["ours"] > 0 for row in rows)


@pytest.fixture
def copied():
    """Ours and PyTorch's run of CartPole's `tuned`, from the same weights."""
    pytest.importorskip("torch")
    run, keys = others.rival("torch_cartpole").Run(0), jax.random.split(jax.random.key(0))
    policy = reinforce((4,), 2, TUNED.agent)
    model = supervised(4, 2, TUNED.model)
    agent = policy.init(keys[0], TUNED.hparams.agent)
    learned = model.init(keys[1], TUNED.hparams.model)
    alone = jax.tree.map(lambda leaf: leaf[0], learned.params.network)
    for network, params in ((run.policy, agent.params), (run.model.network, alone)):
        for layer, ours in zip(network[::2], params["params"].values(), strict=True):
            layer.weight.data = layer.weight.new_tensor(np.array(ours["kernel"]).T)
            layer.bias.data = layer.bias.new_tensor(np.array(ours["bias"]))
    return run, (policy, agent), (model, learned)


def transitions(obs, action, reward, next_obs, terminated, mask):
    never = jnp.zeros(mask.shape, bool)
    arrays = (obs, action, reward, next_obs, terminated, never, mask)
    return Transition(*map(jnp.asarray, arrays))


@pytest.mark.slow
def test_pytorchs_model_learns_as_ours(copied):
    run, _, (model, learned) = copied
    rng, torch = np.random.default_rng(0), others.rival("torch_cartpole").torch
    update, key = jax.jit(model.update), jax.random.key(1)
    for _ in range(20):
        obs, moved = rng.normal(size=(2, 16, 4)).astype(np.float32)
        rest = rng.integers(2, size=16), np.ones(16, np.float32), obs + 0.1 * moved
        ends = rng.random(16) < 0.2
        batch = transitions(obs, *rest, ends, np.ones(16, bool))
        learned, _ = update(learned, batch, jax.random.clone(key), TUNED.hparams.model)
        run.model.update(list(zip(obs, *rest, ends, strict=True)))
    ours = jax.vmap(model.predict, (None, 0, 0, None))(learned.params, batch.obs, batch.action, key)
    theirs = run.model.predict(torch.tensor(obs), torch.tensor(rest[0]))
    for one, other in zip(ours[:3], theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 8])
def test_pytorchs_policy_learns_as_ours(copied, count):
    """Episodes of several lengths: one alone as a real one, 8 as dreams."""
    run, (policy, agent), _ = copied
    rng, torch = np.random.default_rng(0), others.rival("torch_cartpole").torch
    lengths = rng.integers(10, 30, size=count)
    obs = rng.normal(size=(count, 30, 4)).astype(np.float32)
    action, reward = rng.integers(2, size=(count, 30)), np.ones((count, 30), np.float32)
    mask = np.arange(30) < lengths[:, None]
    played = transitions(obs, action, reward * mask, obs, np.zeros_like(mask), mask)
    agent, _ = policy.update(agent, played, jax.random.key(0), TUNED.hparams.agent)
    log_probs = [
        run.policy(torch.tensor(obs[row, :end])).log_softmax(1)[range(end), action[row, :end]]
        for row, end in enumerate(lengths)
    ]
    run.learn(log_probs, [torch.tensor(reward[row, :end]) for row, end in enumerate(lengths)])
    ours = agent.params["params"]["Dense_0"]["kernel"].T
    np.testing.assert_allclose(ours, run.policy[0].weight.detach(), atol=1e-5)


@pytest.mark.slow
def test_pytorchs_dyna_solves_cartpole_as_soon_as_ours():
    """Within the spread of the record `cartpole_tuned`: 100 runs, from 184 to 416 episodes."""
    pytest.importorskip("torch")
    solve = others.rival("torch_cartpole").episodes_to_solve
    results = json.loads((others.EXAMPLES.parents[1] / RECORD).read_text())
    ours = results["arms"]["dyna"]["episodes_to_solve"]["per_seed"]
    theirs = [solve(seed) for seed in range(3)]
    assert all(min(ours) <= one <= max(ours) for one in theirs), theirs


@pytest.mark.parametrize("world", frames.WORLDS)
def test_pytorch_learns_from_frames_by_the_presets_counts(world):
    """And with networks of as many weights."""
    pytest.importorskip("torch"), pytest.importorskip("ale_py")
    rival = others.rival("torch_frames")
    theirs, (preset, arms, arm) = getattr(rival, world.upper()), frames.WORLDS[world]
    ours, setup = arms(preset.resolved())[arm].args[0], preset.resolved()
    dyna, agent, hparams = setup.dyna, setup.agent, setup.hparams
    expected = {
        "model_updates": dyna.model_updates, "updates": agent.updates,
        "fake_updates": agent.fake_updates, "dream_episodes": dyna.dream_episodes,
        "dream_steps": dyna.dream_steps, "capacity": dyna.num_episodes * dyna.num_steps,
        "fake_capacity": agent.fake_capacity, "double": agent.double,
        "discount": hparams.agent.discount, "target_rate": hparams.agent.target_rate,
        "priority": hparams.agent.priority_exponent,
        "learning_rate": hparams.agent.learning_rate,
    }  # fmt: skip
    assert {name: getattr(theirs, name) for name in expected} == expected
    assert (dyna.dream_updates, dyna.model_batch, agent.batch) == (1, rival.BATCH, rival.BATCH)
    assert dyna.num_steps == rival.STEPS
    learner, key = rival.Learner(theirs), jax.random.key(0)
    assert learner.model.rate == hparams.model.learning_rate
    for network, params in (
        (learner.values, ours.agent.init(key, hparams.agent).params),
        (learner.model, ours.model.init(key, hparams.model).params),
    ):
        weights = sum(weight.numel() for weight in network.parameters())
        assert weights == sum(leaf.size for leaf in jax.tree.leaves(params["params"]))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["MAZE", "PONG"])
def test_pytorch_learns_from_frames(world):
    pytest.importorskip("torch"), pytest.importorskip("ale_py")
    rival = others.rival("torch_frames")
    learner = rival.Learner(replace(getattr(rival, world), fake_updates=5, dream_episodes=2))
    learner.episode()
    learner.episode()
    assert len(learner.real.data) == 400 and learner.fake.data

"""A run's numbers do not depend on who is computed beside it: alone, in any company, at any place,
interrupted or not, it is the same run bit for bit.
"""

import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import DYNA, MODEL, MODEL_FREE, SMALL, hparams, lines
from renamed import respelled

from jaxdyna.dyna.conditional import unknown
from jaxdyna.experiments.engine import Arm, Engine, InputError, Work, checkpoint, runs_of, work
from jaxdyna.experiments.engine.checkpoint import Kept, Store
from jaxdyna.experiments.engine.work import Interrupted, joined
from jaxdyna.experiments.study.arms import Hooks, dyna_arm
from jaxdyna.trees import where_needed

PIECE, UNITS = 4, 11
SEEDS = range(5)
RATES = (0.3, 0.7)


def init(key, hparams):
    key, key_weights = jax.random.split(key)
    weights = jax.random.normal(key_weights, (3, 3))
    return {"weights": weights, "same": weights, "total": 0.0, "key": key}


def step(state, data, unit, hparams):
    """A unit of which some runs need a part and others do not."""
    key, key_noise, key_rare = jax.random.split(state["key"], 3)
    noise = jax.random.normal(key_noise, (3,))
    weights = jnp.tanh(state["weights"] + hparams["rate"] * jnp.outer(noise, data["input"]))

    def rare():
        change = jax.random.normal(key_rare, (3, 3)) @ weights
        return jnp.sin(change), {"rare": change.sum()}

    needed = (noise[0] > 0) & hparams["busy"]
    idle = weights, unknown(jax.eval_shape(rare)[1])
    weights, metrics = where_needed((unit >= 2) & needed, rare, idle)
    total = state["total"] + jnp.abs(noise).sum()
    new = {"weights": weights, "same": state["same"], "total": total, "key": key}
    return new, {"total": total, "show_weights": weights, "unit": unit * 1.0} | metrics


def data(key, hparams):
    return {"input": jax.random.normal(jax.random.fold_in(key, 5), (3,)) * hparams["rate"]}


def collect(runs):
    drawn = [np.random.default_rng([runs.base, seed]).normal(size=3) for seed in runs.seed]
    return {"input": np.stack(drawn).astype(np.float32)}


def judge(state, data, key, hparams):
    drawn = jax.random.normal(key, (2,)) * hparams["rate"]
    return {"judged": drawn @ state["weights"][:2] + data["input"], "scalar": state["total"]}


def show(state, data, key, hparams):
    return {"film": jax.random.normal(key, (5,)) + state["weights"][0, 0]}


def making(block, **changes):
    parts = {"init": init, "step": step, "data": data, "judge": judge, "show": show}
    return Work(**parts | {"piece": PIECE, "block": block} | changes)


def arm(played, rate=RATES[0], units=UNITS, busy=True):
    return Arm(played, {"rate": rate, "busy": busy}, units)


def over(curves):
    """Depends on a run's own numbers alone."""
    return curves["total"].max(1) > 15


def play(engine, arms, seeds=SEEDS, over=None, base=0, **rest):
    """What each run came to, by (arm's number, seed)."""
    runs = runs_of(arms, list(seeds), base)
    played = engine.play(arms[0].work, runs, over, **rest)
    names = [(number, seed) for number in range(len(arms)) for seed in seeds]
    return dict(zip(names, played.curves, strict=True))


def assert_same_run(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert ours[name].dtype == theirs[name].dtype
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def assert_same_runs(ours, theirs):
    """Those that both have."""
    both = [name for name in ours if name in theirs]
    assert both
    for name in both:
        assert_same_run(ours[name], theirs[name])


@pytest.mark.parametrize("until", [None, over], ids=["to the end", "until over"])
@pytest.mark.parametrize("block", [1, 2, 5])
def test_a_run_is_the_same_in_any_company(block, until):
    played = making(block)
    engine = Engine(workers=1)
    arms = [arm(played), arm(played, RATES[1]), arm(played, units=6), arm(played, busy=False)]
    alone = {
        (number, seed): play(engine, [one], [seed], until)[0, seed]
        for number, one in enumerate(arms)
        for seed in SEEDS
    }
    at_once = Engine(workers=4, programs=engine.programs)
    ends = {len(run["total"]) for run in alone.values()}
    assert ends == ({6, 8, UNITS} if until else {6, UNITS})
    for by in (engine, at_once):
        assert_same_runs(play(by, arms, SEEDS, until), alone)  # a sweep, its units differing
        assert_same_runs(play(by, arms[:1], SEEDS[::-1], until), alone)
        for shard in (SEEDS[1::2], SEEDS[2::2]):
            assert_same_runs(play(by, arms[:2], shard, until), alone)
    for place in range(block):  # every place in a block
        others = [seed for seed in SEEDS if seed != 3]
        seeds = [*others[:place], 3, *others[place:]]
        assert_same_runs(play(at_once, arms[:1], seeds, until), alone)
    assert len(engine.programs) == 1


def test_there_is_a_worker_for_every_core():
    """However many devices JAX has made of the CPU before, as it does here."""
    assert work.places(None) == [jax.devices()[0]] * work.cores()
    assert work.places(3) == [jax.devices()[0]] * 3


def test_a_run_is_the_same_on_every_device(monkeypatch):
    played = making(2)
    alone = play(Engine(workers=1), [arm(played)])
    monkeypatch.setattr(work, "places", lambda workers: jax.devices()[:2])
    engine = Engine()
    assert_same_runs(play(engine, [arm(played)]), alone)
    assert len({place for _, _, place in engine.programs}) == 2


def test_seeds_and_base_seeds_are_different_runs():
    played = making(2)
    engine = Engine()
    runs = [*play(engine, [arm(played)]).values(), *play(engine, [arm(played)], base=9).values()]
    assert len({run["total"].tobytes() for run in runs}) == 2 * len(SEEDS)
    assert len({run["judged"].tobytes() for run in runs}) == 2 * len(SEEDS)


def test_runs_are_judged_with_other_keys():
    runs = work.Runs(np.arange(3), 7, None, None, None)
    keys = [tuple(row) for keys in (runs.keys, runs.judging) for row in jax.random.key_data(keys)]
    assert len(set(map(str, keys))) == 6


def test_what_the_host_collects_goes_to_its_own_run():
    asked = []

    def told(runs):
        asked.append(list(runs.seed))
        return collect(runs)

    played = making(2, data=None, collect=told)
    engine = Engine(workers=2)
    whole = play(engine, [arm(played)])
    assert asked == [list(SEEDS)]
    assert_same_runs(play(engine, [arm(played)], SEEDS[::-1]), whole)
    assert_same_runs(play(engine, [arm(played, RATES[1]), arm(played)], [4]), {(1, 4): whole[0, 4]})


def test_the_first_run_alone_is_shown():
    runs = play(Engine(), [arm(making(2)), arm(making(2), RATES[1])], [2, 0])
    for (_, seed), run in runs.items():
        assert ("show_film" in run) == ("show_weights" in run) == (seed == 0)
    assert runs[0, 0]["show_weights"].shape == (UNITS, 3, 3)
    assert runs[0, 0]["judged"].shape == (3,) and runs[0, 0]["scalar"].shape == ()


def test_runs_are_looked_at_after_whole_pieces_and_at_their_own_ends_only():
    looked = []

    def told(curves):
        looked.append(curves["total"].shape[1])
        return curves["unit"][:, -1] >= 5

    played = making(3)
    runs = play(Engine(workers=1), [arm(played, units=units) for units in (3, 6, 11)], [0, 1], told)
    assert set(looked) == {4, 8}
    ends = {number: len(run["total"]) for (number, _), run in runs.items()}
    assert ends == {0: 3, 1: 6, 2: 8}


def test_curves_are_nan_after_a_runs_own_end():
    played = making(3)
    runs = play(Engine(), [arm(played, units=units) for units in (3, 6, 8)], [0])
    curves = joined(list(runs.values()))
    assert curves["total"].shape == (3, 8) and curves["total"].dtype == np.float32
    assert np.isfinite(curves["total"]).sum(1).tolist() == [3, 6, 8]
    for row, run in zip(curves["total"], runs.values(), strict=True):
        np.testing.assert_array_equal(row[: len(run["total"])], run["total"])
    assert curves["scalar"].shape == (3,) and curves["judged"].shape == (3, 3)
    np.testing.assert_array_equal(curves["show_film"], runs[0, 0]["show_film"])


def test_arms_of_one_work_and_their_settings_are_one_program():
    chex.clear_trace_counter()
    once = chex.assert_max_traces(n=1)
    played = making(2, init=once(init), step=once(step), data=once(data), judge=once(judge))
    engine = Engine(workers=2)
    for one in (arm(played), arm(played, RATES[1]), arm(played, units=5)):
        play(engine, [one])
    play(engine, [arm(played, rate) for rate in (0.1, 0.2, 0.4)], SEEDS[:3], over)
    assert len(engine.programs) == 1


def stopping_after(
    engine, pieces, over=lambda curves: np.zeros(len(next(iter(curves.values()))), bool)
):
    """Ctrl-C after so many whole pieces, of whichever blocks."""
    count = iter(range(1, 10_000))

    def looked(curves):
        if next(count) >= pieces:
            engine.interrupted.set()
        return over(curves)

    return looked


@pytest.mark.parametrize("block", [1, 3])
def test_interrupted_anywhere_and_resumed_is_uninterrupted(block, tmp_path):
    """Runs that are over are in the blocks too."""
    played = making(block)
    arms = [arm(played, units=units) for units in (3, 17, 9)]
    engine = Engine(workers=2)
    whole = play(engine, arms, SEEDS[:4], over)
    random = np.random.default_rng(block)
    for trial in range(3):
        store, times = Store(tmp_path / str(trial)), 0
        while True:
            again = Engine(workers=2, programs=engine.programs)
            until = stopping_after(again, random.integers(1, 4), over)
            try:
                runs = play(again, arms, SEEDS[:4], until, store=store)
                break
            except Interrupted:
                times += 1
        assert times > 0
        assert_same_runs(runs, whole)


def test_a_crash_costs_no_more_than_what_came_after_the_last_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
    played = making(3)
    engine = Engine(workers=1)
    whole = play(engine, [arm(played, units=23)])
    store, pieces = Store(tmp_path), []

    def crash(stage, done, over):
        pieces.append(done)
        if len(pieces) % 3 == 0:
            raise RuntimeError("crash")

    for _ in range(3):
        with pytest.raises(RuntimeError):
            play(engine, [arm(played, units=23)], store=store, say=crash)
    assert_same_runs(play(engine, [arm(played, units=23)], store=store), whole)
    assert_same_runs(play(engine, [arm(played, units=23)], store=store), whole)  # all are over


@pytest.mark.parametrize(
    ("changes", "leaf"),
    [
        ({"more": jnp.zeros(2)}, "state['more'] was not there and is float32[2, 2]"),
        ({"total": jnp.zeros(3)}, "state['total'] was float32[2] and is float32[2, 3]"),
        ({"total": jnp.int32(0)}, "state['total'] was float32[2] and is int32[2]"),
        ({"same": None}, "state['same'] was float32[2, 3, 3] and is not there"),
    ],
)
def test_a_checkpoint_of_another_structure_is_refused(changes, leaf, tmp_path):
    engine, store = Engine(workers=1), Store(tmp_path)
    with pytest.raises(Interrupted):
        play(engine, [arm(making(2))], over=stopping_after(engine, 1), store=store)

    def other(key, hparams):
        return init(key, hparams) | changes

    def still(state, data, unit, hparams):
        return state, {"total": jnp.float32(0)}

    with pytest.raises(InputError) as error:
        play(Engine(), [arm(making(2, init=other, step=still))], store=store)
    assert leaf in str(error.value) and "\n" not in str(error.value)


def test_an_exception_in_a_block_stops_the_others_and_is_raised():
    told = []

    def fail(stage, done, over):
        told.append((stage, threading.current_thread()))
        if stage == "running":
            raise ZeroDivisionError

    played = making(1)
    engine = Engine(workers=1)
    with pytest.raises(ZeroDivisionError):
        play(engine, [arm(played)], say=fail)
    assert [stage for stage, _ in told] == ["compiling", "running"]
    with pytest.raises(ZeroDivisionError):
        play(Engine(workers=2, programs=engine.programs), [arm(played)], say=fail)
    assert [stage for stage, _ in told].count("running") <= 3
    assert_same_runs(play(engine, [arm(played)]), play(engine, [arm(played)]))  # it goes on


def test_what_the_rule_raises_is_raised():
    def broken(curves):
        raise KeyError("real_return")

    with pytest.raises(KeyError):
        play(Engine(), [arm(making(2))], over=broken)


def test_dyna_is_the_same_in_any_company(tmp_path):
    """REINFORCE with dreams: swept, in a shard, interrupted."""

    def score(dyna, config, state, key, hparams):
        return {"drawn": jax.random.uniform(key) + jax.tree.leaves(state.agent)[0].mean()}

    def film(dyna, config, state, key, hparams):
        return {"film": jax.random.uniform(key, (3,))}

    hooks = Hooks(score, film, piece=2, block=2)
    make = partial(dyna_arm, DYNA, SMALL, hooks=hooks)
    arms = [make(hparams()), make(hparams(fake_weight=0.0)), make(hparams(real_weight=0.5))]
    assert arms[0].work is arms[1].work
    engine = Engine(workers=1)
    alone = {
        (number, seed): play(engine, [one], [seed])[0, seed]
        for number, one in enumerate(arms)
        for seed in (0, 1, 2)
    }
    assert len({run["drawn"].tobytes() for run in alone.values()}) == len(alone)
    assert_same_runs(play(engine, arms, [0, 1, 2]), alone)
    assert_same_runs(play(engine, arms, [2, 0]), alone)
    stopped = Engine(workers=1, programs=engine.programs)
    with pytest.raises(Interrupted):
        play(stopped, arms, [0, 1, 2], stopping_after(stopped, 3), store=Store(tmp_path))
    assert_same_runs(play(engine, arms, [0, 1, 2], store=Store(tmp_path)), alone)
    assert len(engine.programs) == 1


# ---- runs that are over leave


def breaking(state, data, unit, hparams):
    """Now and then a run's numbers break."""
    state, metrics = step(state, data, unit, hparams)
    breaks = (7 * state["total"] + hparams["rate"]) % 1 < 0.01
    state |= {"weights": jnp.where(breaks, jnp.nan, state["weights"])}
    return state, metrics | {"diverged": breaks * 1.0}


def scattered(curves):
    """At the end of every piece one of six runs is over."""
    return (curves["total"][:, PIECE - 1 :: PIECE] % 1 < 0.16).any(1)


LEAVING = making(3, step=breaking)
LEAVING_ARMS = [arm(LEAVING, units=42), arm(LEAVING, RATES[1], units=31)]
MANY = range(11)


def pieces(arms, seeds, over=scattered, workers=1, programs=None, **rest):
    """What runs came to, and how many pieces of blocks were computed."""
    told = []
    engine = Engine(workers=workers, programs={} if programs is None else programs)
    played = play(engine, arms, seeds, over, say=lambda stage, *_: told.append(stage), **rest)
    return played, told.count("running")


@pytest.fixture(scope="module")
def leaving():
    """Runs of blocks that were each played alone, the pieces of these, and their programs."""
    programs, alone, count = {}, {}, 0
    for number, one in enumerate(LEAVING_ARMS):
        for first in range(0, len(MANY), 3):
            played, more = pieces([one], MANY[first : first + 3], programs=programs)
            alone |= {(number, seed): run for (_, seed), run in played.items()}
            count += more
    ends = [len(run["total"]) for run in alone.values()]
    assert len(set(ends)) > 7 and {31, 42} <= set(ends)
    assert sum(bool(run["diverged"].any()) for run in alone.values()) in range(2, 8)
    return alone, count, programs


def fewest(alone):
    """Pieces that blocks of three take where all runs at a unit are as few blocks as can be."""
    ends = np.array([len(run["total"]) for run in alone.values()])
    cuts = sorted({*range(0, 42, PIECE), 31})  # the shorter arm ends in mid-piece
    looked = [next(cut for cut in [*cuts, 42] if cut >= end) for end in ends]
    return sum(-(-sum(end > cut for end in looked) // 3) for cut in cuts)


def test_runs_that_are_over_leave_and_the_rest_is_the_same(leaving):
    alone, count, programs = leaving
    whole, fewer = pieces(LEAVING_ARMS, MANY, programs=programs)
    assert_same_runs(whole, alone)
    assert len(whole) == len(alone) == 22
    assert fewer == fewest(alone) < 0.8 * count
    for workers in (2, 3):
        ours, several = pieces(LEAVING_ARMS, MANY, workers=workers, programs=programs)
        assert_same_runs(ours, alone)
        assert several < count
    assert len(programs) == 1


def test_blocks_wait_only_where_memory_affords_it(leaving, monkeypatch):
    alone, _, programs = leaving
    asked = []
    monkeypatch.setattr(work, "spare", lambda need, most, place: asked.append((need, most)) or 0)
    ours, as_many = pieces(LEAVING_ARMS, MANY, programs=programs)
    assert_same_runs(ours, alone)
    assert as_many > fewest(alone)
    assert {most for _, most in asked} == {work.BEGUN} and min(need for need, _ in asked) > 0


def test_what_the_host_collects_follows_its_runs():
    played = making(3, data=None, collect=collect)
    whole, count = pieces([arm(played, units=42)], MANY)
    alone = {}
    for first in range(0, len(MANY), 3):
        ours, more = pieces([arm(played, units=42)], MANY[first : first + 3])
        alone, count = alone | ours, count - more
    assert_same_runs(whole, alone)
    assert count < 0


def test_devices_help_one_another(leaving, monkeypatch):
    """Also where one of them has begun all blocks."""
    alone, count, _ = leaving
    begin, played, on = work._Pool._begin, work._Block.play, []

    def greedy(pool, place):
        while pool.unbegun:
            begin(pool, place)

    def noted(block):
        on.append(block.program.place)
        played(block)

    monkeypatch.setattr(work, "places", lambda workers: jax.devices()[:2])
    monkeypatch.setattr(work._Pool, "_begin", greedy)
    monkeypatch.setattr(work._Block, "play", noted)
    ours, fewer = pieces(LEAVING_ARMS, MANY)
    assert_same_runs(ours, alone)
    assert fewer == len(on) < count
    assert set(on) == set(jax.devices()[:2])


@pytest.mark.parametrize("workers", [1, 2])
def test_interrupted_while_blocks_wait_and_resumed_is_uninterrupted(leaving, workers, tmp_path):
    alone, _, programs = leaving
    random = np.random.default_rng(workers)
    for trial in range(2):
        store, times, played = Store(tmp_path / str(trial)), 0, 0
        while True:
            again = Engine(workers=workers, programs=programs)
            until, told = stopping_after(again, random.integers(1, 9), scattered), []
            try:
                runs = play(again, LEAVING_ARMS, MANY, until, store=store,
                            say=lambda *said, told=told: told.append(said))  # fmt: skip
                break
            except Interrupted:
                times += 1
                lasted = [done for stage, done, _ in told if stage == "running"]
                assert lasted[0] >= played, "what was played before is lost"
                played = lasted[-1]
        assert times > 3
        assert_same_runs(runs, alone)


def test_killed_between_any_two_files_and_resumed_is_uninterrupted(leaving, tmp_path, monkeypatch):
    """Blocks are saved at different times, and not at once; runs go from one to another."""
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
    alone, count, programs = leaving
    folder, save, random = tmp_path / "now" / "arm", Store.save, np.random.default_rng(0)
    folder.parent.mkdir()
    left = []

    def saving(store, *written):
        save(store, *written)
        if random.random() < 0.08:
            left.append(tmp_path / str(len(left)) / "arm")
            shutil.copytree(folder, left[-1])

    with monkeypatch.context() as patch:
        patch.setattr(Store, "save", saving)
        pieces(LEAVING_ARMS, MANY, programs=programs, store=Store(folder))
    assert len(left) > 5
    for killed in left:
        ours, rest = pieces(LEAVING_ARMS, MANY, programs=programs, store=Store(killed))
        assert_same_runs(ours, alone)
        assert rest < count


def test_the_two_newest_checkpoints_are_of_different_units(leaving, tmp_path, monkeypatch):
    """Also where all is saved again because of Ctrl-C, or before anything was played on."""
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
    for played in (10, 4):
        engine = Engine(workers=1, programs=leaving[2])
        store, until = Store(tmp_path / "arm"), stopping_after(engine, played, scattered)
        with pytest.raises(Interrupted):
            play(engine, LEAVING_ARMS[:1], MANY, until, store=store)
        both = [row for row in range(len(MANY)) if (store.folder / f"run{row}.before.npz").exists()]
        for row in both:
            before = store._read(store.folder / f"run{row}.before.npz")
            assert before.done < store.load(row).done or store.load(row).over
        assert len(both) > 5
        engine.interrupted.set()
        with pytest.raises(Interrupted):
            play(engine, LEAVING_ARMS[:1], MANY, scattered, store=Store(store.folder))


@pytest.mark.parametrize("workers", [1, 2])
def test_where_a_block_fails_those_that_wait_are_saved(leaving, workers, tmp_path):
    alone, count, programs = leaving
    told = []

    def fail(stage, done, over):
        told.append(stage)
        if told.count("running") == 20:
            raise ZeroDivisionError

    store = Store(tmp_path / "arm")
    with pytest.raises(ZeroDivisionError):
        play(Engine(workers, programs=programs), LEAVING_ARMS, MANY, scattered, store=store,
             say=fail)  # fmt: skip
    kept = [store.load(row) for row in range(22)]
    assert sum(run is None for run in kept) <= 3  # of the one that failed, never saved before
    ours, rest = pieces(LEAVING_ARMS, MANY, programs=programs, store=store)
    assert_same_runs(ours, alone)
    assert rest < count


def test_who_plays_some_of_the_runs_counts_the_seconds_of_these(tmp_path):
    """Other processes' checkpoints lie beside them."""
    store = Store(tmp_path)
    for number, seconds in ((0, 5.0), (3, 50.0)):
        store.save(number, Kept(1, {"state": np.zeros(1)}, {"loss": np.zeros(1)}), seconds)
    assert store.seconds() == 50 and store.seconds([0, 1]) == 5 and store.seconds([1]) == 0


def test_dyna_is_the_same_where_runs_leave():
    """REINFORCE with dreams, in blocks of three."""
    made = dyna_arm(DYNA, replace(SMALL, num_episodes=16), hparams(), Hooks(piece=2, block=3))

    def over(curves):
        return (curves["real_return"][:, 1::2] < 14).any(1)

    whole, fewer = pieces([made], MANY, over)
    alone, programs, count = {}, {}, 0
    for first in range(0, len(MANY), 3):
        ours, more = pieces([made], MANY[first : first + 3], over, programs=programs)
        alone, count = alone | ours, count + more
    assert len({len(run["real_return"]) for run in alone.values()}) > 3
    assert_same_runs(whole, alone)
    assert fewer < count


COMMAND = """
import sys
from jaxdyna.experiments.engine import checkpoint, main
from jaxdyna.experiments.engine.record import command_of
checkpoint.CHECKPOINT_SECONDS = 0.1
parts, flags, prog = command_of("jaxdyna.experiments.{world}", *sys.argv[1:])
sys.exit(main(*parts, argv=flags, prog=prog))
"""
KILLED = {
    "catch": [
        "catch", "--rows", "3", "--columns", "2", "--seeds", "7", "--block", "2",
        "--episodes", "600", "--stop-after-solved", "400", "--agent.n-step", "1",
        "--agent.updates", "1", "--agent.fake-updates", "1",
        "--agent.batch", "16", "--widths", "2", "--dyna.num-real-first", "3",
        "--dyna.model-updates", "1", "--dyna.model-batch", "4", "--dyna.dream-episodes", "2",
    ],
    "maze": respelled(["maze", *tiny.MAZE, "--episodes", "300"]),
    "frames": respelled(["maze", *tiny.MAZE_MODEL, "--lean.updates", "400"]),
    "gymnasium": [
        "any", "--env", "gymnasium:CartPole-v1", "--seeds", "3", "--episodes", "300",
        "--hparams.env.max-steps", "30", "--dyna.model-updates", "3", "--agent.batch", "8",
        "--agent.fake-updates", "2", "--dyna.dream-episodes", "4",
    ],
}  # fmt: skip
ONE = {"catch": "dyna", "maze": "dyna", "frames": "lean", "gymnasium": "dyna"}


@pytest.mark.slow
@pytest.mark.parametrize("name", KILLED)
def test_killed_ten_times_and_resumed_is_uninterrupted(name, tmp_path):
    """kill -9 at any moment between the imports and the end."""
    world, *arguments = KILLED[name]

    def play(out, seconds=None):
        """Whether it came to its end before it was killed; goes on with what is there."""
        begun = (out / "checkpoints" / "settings.json").exists() or (out / "results.json").exists()
        more = ["--resume"] if begun else []
        command = [sys.executable, "-c", COMMAND.format(world=world), *arguments,
                   "--arms", ONE[name], "--out", str(out), *more]  # fmt: skip
        try:
            subprocess.run(command, capture_output=True, check=True, timeout=seconds)  # kill -9
        except subprocess.TimeoutExpired:
            return False
        return True

    assert play(tmp_path / "first")  # compiles
    began = time.monotonic()
    assert play(tmp_path / "whole")
    seconds, whole = time.monotonic() - began, np.load(tmp_path / "whole" / "curves.npz")
    random, kills, found = np.random.default_rng(0), 0, set()
    for out in map(tmp_path.joinpath, map(str, range(30))):  # a run that ends is begun anew
        while kills < 10:
            if play(out, seconds=random.uniform(0.3, 0.9) * seconds):
                break
            kills += 1
            found.add(tuple(sorted(path.name for path in out.glob("checkpoints/*/*.npz"))))
        else:
            assert play(out)
        ours = np.load(out / "curves.npz")
        assert ours.files == whole.files
        for array in ours.files:
            np.testing.assert_array_equal(ours[array], whole[array], err_msg=array)
        assert lines(out) == lines(tmp_path / "whole")
        if kills == 10:
            break
    assert kills == 10 and any(found)  # some left work to go on with


def test_a_given_model_is_dreamed_in_as_it_is():
    """By run; one that does not train is not given."""
    config = replace(SMALL, model_updates=0, num_episodes=3)

    def given(runs):
        shapes = jax.eval_shape(MODEL.init, jax.random.key(0), hparams().model).params

        def filled(leaf):
            return np.stack([np.full(leaf.shape, 1 + seed, leaf.dtype) for seed in runs.seed])

        return jax.tree.map(filled, shapes)

    def judge(dyna, config, state, key, hparams):
        return {
            "least": jnp.stack([leaf.min() for leaf in jax.tree.leaves(state.model.params)]),
            "most": jnp.stack([leaf.max() for leaf in jax.tree.leaves(state.model.params)]),
        }

    given.check = lambda: None
    hooks = Hooks(judge, given=given)
    arm = dyna_arm(DYNA, config, hparams(), hooks)
    for seed, curves in enumerate(Engine().play(arm.work, runs_of([arm], [0, 1], 0)).curves):
        assert (curves["least"] == 1 + seed).all() and (curves["most"] == 1 + seed).all()
    assert dyna_arm(DYNA, config, hparams(model_trains=False), hooks).work.collect is None
    assert dyna_arm(MODEL_FREE, config, hparams(), hooks).work.collect is None


def test_what_is_compiled_ahead_is_not_compiled_again_and_counted_once(monkeypatch):
    made = []
    whole = work._Program.__init__

    def counted(self, played, *rest):
        made.append(played)
        time.sleep(0.2)
        whole(self, played, *rest)

    monkeypatch.setattr(work._Program, "__init__", counted)
    one, other = making(2), making(3)
    hosted = making(1, data=None, collect=collect)
    runs = {played: runs_of([arm(played)], list(SEEDS), 0) for played in (one, other, hosted)}
    engine = Engine(workers=2)
    began = time.perf_counter()
    engine.prepare(runs)
    took = time.perf_counter() - began
    assert set(made) == {one, other}  # not what waits for the host's data
    played = {one: engine.play(one, runs[one]) for one in (one, other)}
    again = engine.play(one, runs[one])
    assert len(made) == 2
    compile_s = [done.seconds.compile_s for done in played.values()]
    assert sum(compile_s) == pytest.approx(took, rel=0.1)
    assert again.seconds.compile_s < 0.1 * took
    alone = Engine(workers=2).play(one, runs[one])
    for ours, theirs in zip(played[one].curves, alone.curves, strict=True):
        assert_same_run(ours, theirs)

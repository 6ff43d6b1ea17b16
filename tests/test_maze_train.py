"""Learning to act in the Maze: command line, report, what is measured of an episode."""

import json
import signal
from dataclasses import replace

import jax
import numpy as np
import pytest
import tiny
from parts import assert_same

from jaxdyna.dyna import make_train
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.experiments import maze, maze_levers, run
from jaxdyna.experiments.maze_train import behaviour, make_arms
from jaxdyna.experiments.maze_train_options import LEAN, PAPER, Options, agent_config
from jaxdyna.experiments.maze_train_report import replay_frames
from jaxdyna.experiments.session import JUDGING
from jaxdyna.experiments.storage import read_curves
from jaxdyna.models import PixelHParams
from jaxdyna.planners import solve_maze
from jaxdyna.rollout import first_states, rollout
from jaxdyna.statistics import SolveRule, episodes_to_solve

TINY = [*tiny.MAZE, "--arms", "model_free", "dyna"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("maze")
    assert maze.main([*TINY, "--out", str(out)]) == 0
    return out


def test_it_leaves_what_the_contract_asks_for(finished):
    results = json.loads((finished / "results.json").read_text())
    assert results["experiment"] == "maze" and set(results["arms"]) == {"model_free", "dyna"}
    for arm in results["arms"].values():
        for name in ("episodes_to_solve", "first_solved", "real_steps_to_solve"):
            assert len(arm[name]["per_seed"]) == 2
        assert "0.95 of the mean oracle return" in arm["solve_rule"]
        assert arm["greedy"]["share"]["mean"] <= 1
    assert results["device"]["peak_memory_gib"] > 0.1
    report = (finished / "report.md").read_text()
    for name in ("fig8.png", "solved.png", "behaviour.png", "film_dyna.gif"):
        assert f"({name})" in report and (finished / name).exists()
    curves = read_curves(finished / "curves.npz")
    alone, dyna = curves["model_free"], curves["dyna"]
    np.testing.assert_array_equal(alone["real_return"][:, :30], dyna["real_return"][:, :30])
    np.testing.assert_array_equal(alone["oracle_return"], dyna["oracle_return"])
    assert (dyna["real_return"] <= dyna["oracle_return"] + 1e-4).all()
    assert dyna["film_action"].shape == (1, 52, 8)
    assert np.isnan(dyna["fake_return"][:, :29]).all()
    assert np.isfinite(dyna["fake_return"][:, 29:]).all()


def test_what_is_said_of_an_episode_is_what_happened():
    world, params = Maze(size=3, num_obstacles=2), MazeParams(max_steps=30)
    env, key = FrameStack(world), jax.random.key(2)

    def act(obs, key):
        return jax.random.randint(key, (), 0, 5)

    played = rollout(env, act, key, params, 1, num_steps=30)
    begun = first_states(env, jax.random.clone(key), params, 1)
    said = behaviour(world, 30, played, begun, params)
    start = jax.tree.map(lambda leaf: leaf[0], begun.env)
    collisions, reached, state = 0, [], start
    for time, action in enumerate(played.action[0]):
        _, state, _, _, _, info = world.step(jax.random.key(0), state, action, params)
        collisions += int(info["collision"])
        reached += [time + 1] if info["at_goal"] else []
    assert collisions > 0 and reached
    assert said["collisions"] == collisions and said["time_to_goal"] == reached[0]
    assert said["oracle_return"] == solve_maze(world, start, params, 30).best_return
    frames = replay_frames(
        Options(size=3, obstacles=2, steps=30, dream_steps=5),
        said["film_obstacles"], said["film_directions"], said["film_action"],
    )  # fmt: skip
    np.testing.assert_array_equal(frames[1:], played.next_obs[0, ..., -3:])
    never = played._replace(next_obs=played.next_obs.at[..., -2].set(0))
    assert behaviour(world, 30, never, begun, params)["time_to_goal"] == 31


def test_solve_rule_by_hand():
    rule = SolveRule(2, 0.95, "oracle_return")
    curves = {
        "real_return": np.array([[0.0, 90.0, 96.0, 60.0], [0.0, 0.0, 0.0, 0.0]]),
        "oracle_return": np.array([[100.0, 95.0, 100.0, 60.0], [10.0, 10.0, 10.0, 10.0]]),
    }
    solved = episodes_to_solve(rule.score(curves), rule)
    np.testing.assert_array_equal(solved, [3, np.inf])  # 186 of 195


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "1"], "at least 2 cells"),
        (["--dream-steps", "300"], "--dream-steps"),
        (["--hparams.agent.discount", "1.5"], "--hparams.agent.discount"),
        (["--agent.batch", "0"], "batch is 0"),
        (["--hparams.env.max-steps", "7"], "--steps"),
        (["--arms"], "--arms"),
        (["--steps", "30"], "30 steps away"),
        (["--size", "10", "--model", "paper"], "larger --size"),
        (["--hparams.agent.priority-exponent", "-1"], "--hparams.agent.priority-exponent"),
        (["--agent.episodes", "0"], "episodes is 0"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        maze.main(arguments)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1


def test_replays_are_no_larger_than_a_run_can_fill():
    config = agent_config(Options(episodes=120, steps=50))
    assert (config.capacity, config.episodes) == (6000, 120)
    assert agent_config(LEAN).capacity == 30_000
    needed = PAPER.dream_episodes * PAPER.dream_steps
    assert agent_config(PAPER).fake_capacity >= needed
    many = replace(PAPER, dream_episodes=5000, dream_steps=1)
    assert agent_config(many).fake_episodes >= 5000


def test_more_updates_learns_from_real_steps_alone():
    """Whatever is dreamed, its policy is the same; and dyna's is not."""
    options = replace(
        LEAN, size=3, obstacles=1, steps=8, episodes=4, real_first=2, dream_steps=2,
        dream_episodes=4, model_updates=1, model_widths=(4,),
        agent=replace(LEAN.agent, updates=2, fake_updates=2, batch=4, fake_capacity=64),
    )  # fmt: skip

    arms = make_arms(options)
    unjudged = arms["dyna"]._replace(dyna=arms["dyna"].dyna._replace(diagnose=None))
    assert unjudged[:2] == arms["more_updates"][:2]
    train = jax.jit(make_train(*arms["dyna"][:2]))

    def policy(name, **changes):
        hparams = replace(arms[name].hparams, **changes)
        state, _ = train(jax.random.key(0), hparams)
        return state.agent.params, state.agent.steps

    other = PixelHParams(1e-1)
    params, steps = policy("more_updates")
    assert_same(policy("more_updates", model=other, model_trains=True)[0], params)
    assert steps == policy("dyna")[1] == 4 * 2 + 3 * 2
    dreamed, changed = policy("dyna")[0], policy("dyna", model=other)[0]
    same = jax.tree.map(lambda a, b: bool((a == b).all()), dreamed, changed)
    assert not all(jax.tree.leaves(same))


def test_final_policies_are_judged_on_starts_that_no_run_has_seen():
    runs = jax.random.split(jax.random.key(3), 10)
    judging = jax.random.split(jax.random.fold_in(jax.random.key(3), JUDGING), 10)
    both = jax.random.key_data(jax.numpy.concatenate([runs, judging]))
    assert len({tuple(row) for row in np.asarray(both)}) == 20


def test_interrupted_and_resumed_is_uninterrupted(finished, tmp_path, monkeypatch):
    """Ctrl-C once there are dreams: replays, priorities and films come back bit for bit."""
    original = run.Runner.run

    def interrupted_run(self, name, arm, resume=False):
        report = self.report

        def interrupt(stage, done, total, solved):
            report(stage, done, total, solved)
            if (name, stage) == ("dyna", "running") and done >= 32:
                signal.raise_signal(signal.SIGINT)

        self.report = interrupt
        return original(self, name, arm, resume)

    arguments = [*TINY, "--out", str(tmp_path), "--arms", "dyna"]
    with monkeypatch.context() as patch:
        patch.setattr(run.Runner, "run", interrupted_run)
        assert maze.main(arguments) == 130
    assert (tmp_path / "checkpoints" / "dyna").is_dir()
    assert maze.main([*arguments, "--resume"]) == 0
    ours, whole = (read_curves(folder / "curves.npz")["dyna"] for folder in (tmp_path, finished))
    assert_same(ours, whole)


@pytest.mark.slow
def test_levers(tmp_path, monkeypatch):
    few = {"real_first": 2, "dream_episodes": 10, "dream_steps": 2}
    few |= {"model_updates": 40, "model_widths": (4,)}
    agent = replace(LEAN.agent, updates=1, fake_updates=1, batch=4, fake_capacity=64)
    monkeypatch.setattr(maze_levers, "LEAN", replace(LEAN, agent=agent, **few))
    names = ["dyna (lean preset)", "untrained model (placebo)", "model: 3 updates an episode"]
    arguments = ["--size", "4", "--obstacles", "1", "--steps", "20", "--seeds", "2"]
    arguments += ["--episodes", "32", "--out", str(tmp_path), "--arms", *names]
    assert replace(maze_levers.LEVERS, real_first=2).main(arguments) == 0
    text = (tmp_path / "report.md").read_text()
    assert "over 3 models" in text and (tmp_path / "accuracy.png").exists()
    arms = json.loads((tmp_path / "results.json").read_text())["arms"]
    errors = {name: np.mean(arms[name]["model_error"]) for name in names}
    assert errors["dyna (lean preset)"] < errors["model: 3 updates an episode"] <= 1


def test_every_lever_is_told_apart_from_the_preset():
    arms = maze_levers.levers(maze_levers.LEVERS.default)
    base, *others = (
        (arm.dyna.model, arm.config, arm.hparams, arm.dyna.agent) for arm in arms.values()
    )
    assert len(arms) > 20 and all(other != base for other in others)
    judged = [name for name, arm in arms.items() if arm.dyna.diagnose is not None]
    assert sum(not name.startswith(maze_levers.OTHER) for name in judged) == 9

"""Learning to act in the Maze: command line, report, what is measured of an episode."""

import json
import os
import signal
from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same
from PIL import Image
from renamed import respelled

import jaxdyna
from jaxdyna.agents import DQNConfig
from jaxdyna.dyna import DynaConfig
from jaxdyna.envs import Drawn, FrameStack, Maze, MazeParams, MazeState, ReplayedParams
from jaxdyna.experiments.engine import main
from jaxdyna.experiments.engine.progress import Bars
from jaxdyna.experiments.engine.storage import read_curves
from jaxdyna.experiments.maze import LEVERS, PARTS
from jaxdyna.experiments.maze.acting import describe, learned_at
from jaxdyna.experiments.maze.arms import agent_of, arms, behaviour, held_back, model_of, parts
from jaxdyna.experiments.maze.options import LEAN, PAPER, TUNED
from jaxdyna.experiments.maze.studies import LADDER, SHORT, STEPS, ladder
from jaxdyna.experiments.report import frames
from jaxdyna.experiments.study import arms as study_arms
from jaxdyna.fields import changed, leaves, value_at
from jaxdyna.planners import solve_maze
from jaxdyna.rollout import rollout
from jaxdyna.statistics import SolveRule, episodes_to_solve

TINY = [*respelled(["maze", *tiny.MAZE])[1:], "--arms", "dyna"]


def run(*argv):
    return main(*PARTS, argv=argv, prog="python -m jaxdyna.experiments.maze")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("maze")
    assert run(*TINY, "--out", str(out)) == 0
    return out


def test_it_leaves_what_the_contract_asks_for(finished):
    results = json.loads((finished / "results.json").read_text())
    assert results["experiment"] == "maze" and set(results["arms"]) == {"dyna"}
    for arm in results["arms"].values():
        for name in ("episodes_to_solve", "first_solved", "real_steps_to_solve"):
            assert len(arm[name]["per_seed"]) == 2
        assert "0.95 of the mean optimal return" in arm["solve_rule"]
        assert arm["greedy"]["share"]["mean"] <= 1
    assert set(results["arms"]["dyna"]["model"]) == {"wrong_frames", "wrong_rewards"}
    report = (finished / "report.md").read_text()
    for name in ("fig8.png", "behaviour.png", "model.png"):
        assert f"({name})" in report and (finished / name).exists()
    assert "Not the paper's, or not said there: Double DQN; " in report
    dyna = read_curves(finished / "curves.npz")["dyna"]
    assert (dyna["real_return"] <= dyna["optimal_return"] + 1e-4).all()
    assert dyna["greedy_return"].shape == (2, 1000)
    assert np.isnan(dyna["fake_return"][:, :29]).all()
    assert np.isfinite(dyna["fake_return"][:, 29:]).all()


def test_a_film_shows_a_rollout_and_the_dream_of_its_actions(finished, tmp_path):
    left = jaxdyna.load(finished)
    run, scene = left.scenes()["dyna"]
    scene.begin(left.options.seed)
    obs, state = scene.sides["true"].obs, scene.sides["true"].host._state
    actions = []

    def act(obs, key):
        actions.append(int(jax.random.randint(key, (), 0, 5)))
        return actions[-1]

    shots = scene.played(act, left.options.seed, 6)
    assert len(shots) == 7 and len(set(actions)) > 2

    def again(env, params, first, actions):
        def follow(obs, key, state):
            return jnp.array(actions)[getattr(state, "env", state).time]

        start = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], first)
        params, key, count = ReplayedParams(params, start), jax.random.key(0), len(actions)
        return rollout(Drawn(env), follow, key, params, 1, num_steps=count, sees_state=True)

    true = again(run.env, run.params, (obs, state), actions)
    full, dream = true.obs[0, 3], run.dream.env  # the first stack without a frame repeated
    dreamed = again(dream, run.dream_params.env, (full, dream.state_of(full)), actions[3:])
    for side, first, played in (("true", obs, true), ("dreamed", full, dreamed)):
        count = played.action.shape[1]
        shown = np.stack([shot[side][0] for shot in shots[-count - 1 :]])
        np.testing.assert_array_equal(shown[0], first[..., -3:])
        np.testing.assert_array_equal(shown[1:], played.next_obs[0, ..., -3:])
        said = f"step {count}, return {round(float(played.reward.sum()), 1):g}"
        assert shots[-1][side][1] == said
    columns = {side: [shot[side] for shot in shots] for side in scene.sides}
    frames.film(tmp_path / "maze.gif", columns)
    with Image.open(tmp_path / "maze.gif") as film:
        cell = frames.CAPTION_WIDTH // 4
        assert film.n_frames == 7 and film.width == 2 * 4 * cell + frames.GAP
        for number, side in ((0, "true"), (0, "dreamed"), (6, "true"), (6, "dreamed")):
            film.seek(number)
            panel = np.asarray(film.convert("RGB"), int)[-4 * cell :]
            panel = panel[:, : 4 * cell] if side == "true" else panel[:, -4 * cell :]
            middles = panel[cell // 2 :: cell, cell // 2 :: cell]
            np.testing.assert_allclose(middles, shots[number][side][0], atol=40)


def test_what_is_said_of_an_episode_is_what_happened():
    record = parts(Maze(), agent_of(TUNED), model_of(TUNED)).record
    world, params = Maze(size=3, num_obstacles=2), MazeParams(max_steps=30)
    env, key = FrameStack(world), jax.random.key(2)

    def act(obs, key):
        return jax.random.randint(key, (), 0, 5)

    @jax.jit
    def play(key):
        return rollout(env, act, key, params, 1, num_steps=30, record=record)

    say = jax.jit(lambda *played: behaviour(world, *played, params))
    played, recorded = jax.tree.map(np.asarray, play(key))
    said = say(played, recorded)
    start = jax.tree.map(lambda leaf: leaf[0, 0], recorded.state)
    step, collisions, reached, state = jax.jit(world.step), 0, [], start
    for time, action in enumerate(played.action[0]):
        _, state, _, _, _, info = step(jax.random.key(0), state, action, params)
        collisions += int(info["collision"])
        reached += [time + 1] if info["at_goal"] else []
    assert collisions > 0 and reached
    assert said["collisions"] == collisions and said["time_to_goal"] == reached[0]
    best = jax.jit(lambda start: solve_maze(world, start, params, 30).best_return)
    assert said["optimal_return"] == best(start)
    never = recorded._replace(info=recorded.info | {"at_goal": np.zeros((1, 30), bool)})
    assert say(played, never)["time_to_goal"] == 31


def test_a_run_that_is_over_keeps_its_own_last_errors():
    """By hand: ten of the first episodes with dreams, ten of the last that each run has played."""
    wrong = np.full((2, 40), np.nan)
    wrong[0], wrong[1, :25] = np.arange(40), 1.0
    judged = {name: np.ones((2, 5)) for name in ("greedy_return", "greedy_optimal")}
    judged |= {name: np.ones((2, 40)) for name in ("collisions", "time_to_goal")}
    curves = {**judged, "greedy_collisions": np.zeros((2, 5)), "wrong_frames": wrong}
    said = describe(changed(TUNED, {"dyna.num_real_first": 15}), curves)
    assert said["model"] == {"wrong_frames": {"first_dreams": (18.5 + 1) / 2, "last": 17.75}}
    assert said["greedy"]["share"]["mean"] == 1 and said["greedy"]["collisions"]["mean"] == 0


def test_who_waits_for_an_obstacle_by_hand():
    """The goal is three cells up. An obstacle steps into the next cell of that way as the agent
    would, turns around there, which takes its tick, and leaves: two steps are to be waited for.
    """
    maze, params = Maze(size=4, num_obstacles=1, start=(3, 3), goal=(0, 3)), MazeParams(max_steps=8)
    cells = (maze.start_cell, maze.goal_cell, [[2, 2]], [1], 0)
    start = MazeState(*(jnp.array(part, jnp.int32) for part in cells))

    @jax.jit
    def play(actions):
        def step(state, action):
            after, info = (maze.step(jax.random.key(0), state, action, params)[n] for n in (1, 5))
            return after, (state, info["at_goal"])

        states, home = jax.lax.scan(step, start, actions)[1]
        way = jnp.cumsum(home) - home == 0
        return held_back(maze, states, actions, way)

    def said(*actions):
        found = play(jnp.array(actions))
        return [int(found[name]) for name in ("threats", "waits", "dawdles")]

    up, wait = 2, 4
    assert said(wait, wait, up, up, up, wait, wait, wait) == [2, 2, 0]
    assert said(up, up, up, wait, wait, wait, wait, wait) == [1, 0, 0]
    assert said(*[wait] * 8) == [2, 2, 6]


def test_what_is_learned_first_by_hand():
    """Two runs: one learns everything, the other plays 60 episodes and learns nothing."""
    shape = (2, 120)
    curves = {name: np.full(shape, value) for name, value in (
        ("collisions", 4.0), ("time_to_goal", 101.0), ("threats", 2.0), ("waits", 1.0),
        ("dawdles", 49.0),
    )}  # fmt: skip
    curves["time_to_goal"][0, 20:] = 31  # of ten, nine do after episode 29
    curves["collisions"][0, 40:] = 0  # nine, and one with four: 0.4
    curves["waits"][0], curves["dawdles"][0] = 0, 29
    curves["waits"][0, 50:], curves["dawdles"][0, 50:] = 2, 0
    curves = {name: np.where(np.arange(120) < [[120], [60]], values, np.nan)
              for name, values in curves.items()}  # fmt: skip
    found = learned_at(curves, 100)
    assert found["goal"].tolist() == [29, np.inf]
    assert found["collisions"].tolist() == [49, np.inf]
    late = np.array([(50 - n) / 50 for n in range(51)])  # what is left of dawdling
    went = 29 * np.minimum(late, 1)
    expected = 50 + int(np.argmax((1 - late) - went / 29 >= 0.25))
    assert found["waits"].tolist() == [expected, np.inf] and 60 < expected <= 100


def test_mpc_init_makes_as_many_updates_as_dyna_on_real_steps_alone():
    options = changed(LEAN, {"agent.fake_updates": 7}).resolved()
    assert options.cloning.updates == 2 * 7
    made = arms(options, judged=False)
    dyna, imitating = made["dyna"](), made["mpc_init"]()
    late = options.dyna.num_real_first + options.shown_episodes
    assert imitating.hparams.num_real_first == late and imitating.hparams.model_trains
    assert imitating.hparams.agent == dyna.hparams.agent.replace(fake_share=0.0)


def test_solve_rule_by_hand():
    rule = SolveRule(2, 0.95, "optimal_return")
    curves = {
        "real_return": np.array([[0.0, 90.0, 96.0, 60.0], [0.0, 0.0, 0.0, 0.0]]),
        "optimal_return": np.array([[100.0, 95.0, 100.0, 60.0], [10.0, 10.0, 10.0, 10.0]]),
    }
    solved = episodes_to_solve(rule.score(curves), rule)
    np.testing.assert_array_equal(solved, [3, np.inf])  # 186 of 195


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "1"], "--size is 1: it must be between 2 and 1000"),
        (["--obstacles", "255"], "--obstacles is 255: there are 254"),
        (["--hparams.agent.discount", "1.5"], "--hparams.agent.discount"),
        (["--agent.batch", "0"], "--agent.batch is 0"),
        (["--hparams.env.max-steps", "7"], "--steps"),
        (["--mpc.discount", "1"], "--hparams.agent.discount"),
        (["--arms"], "--arms"),
        (["--steps", "30"], "30 steps away"),
        (["--sweep", "dyna.dream_steps=5,500"], "other settings do not allow 500"),
        (["--episodes", "50"], "--dyna.num-real-first (N) is 100"),
        (["--size", "10", "--model", "paper"], "--model paper needs a larger one, 11 at least"),
        (["--size", "6", "--network", "plain"], "--network plain needs a larger one, 7 at least"),
        (["--hparams.agent.priority-exponent", "-1"], "--hparams.agent.priority-exponent"),
        (["--agent.episodes", "0"], "--agent.episodes is 0"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1


def test_replays_are_no_larger_than_a_run_can_fill():
    config = agent_of(changed(TUNED, {"episodes": 120, "steps": 50}).resolved())
    assert (config.capacity, config.episodes) == (6000, 120)
    assert agent_of(LEAN.resolved()).capacity == 30_000
    tuned = TUNED.resolved()
    assert agent_of(tuned).fake_capacity >= tuned.dyna.dream_episodes * tuned.dyna.dream_steps
    many = changed(TUNED, {"dyna.dream_episodes": 5000, "dyna.dream_steps": 1}).resolved()
    assert agent_of(many).fake_episodes >= 5000


@pytest.mark.slow  # as of the frame models and of CartPole
def test_interrupted_and_resumed_is_uninterrupted(finished, tmp_path, monkeypatch):
    """Ctrl-C once there are dreams: replays, priorities and films come back bit for bit."""
    original = Bars.tell

    def interrupt(self, name, stage, done, over):
        original(self, name, stage, done, over)
        if stage == "running" and 32 <= done < 40:
            os.kill(os.getpid(), signal.SIGINT)

    arguments = [*TINY, "--out", str(tmp_path), "--arms", "dyna"]
    with monkeypatch.context() as patch:
        patch.setattr(Bars, "tell", interrupt)
        assert run(*arguments) == 130
    assert list((tmp_path / "checkpoints").glob("dyna*/run*.npz"))
    assert run(*arguments, "--resume") == 0
    ours, whole = (read_curves(folder / "curves.npz")["dyna"] for folder in (tmp_path, finished))
    assert_same(ours, whole)


@pytest.mark.slow
def test_levers(tmp_path):
    names = ["dyna (lean preset)", "untrained model (placebo)", "model: 3 updates an episode"]
    arguments = [
        "--part", "levers", "--size", "4", "--obstacles", "1", "--steps", "20", "--seeds", "2",
        "--episodes", "32", "--dyna.num-real-first", "2", "--dyna.dream-episodes", "10",
        "--dyna.dream-steps", "2", "--dyna.model-updates", "40", "--model-widths", "4",
        "--agent.updates", "1", "--agent.fake-updates", "1", "--agent.batch", "4",
        "--agent.fake-capacity", "64", "--out", str(tmp_path), "--arms", *names,
    ]  # fmt: skip
    assert run(*arguments) == 0
    text = (tmp_path / "report.md").read_text()
    assert "over 3 models" in text and (tmp_path / "accuracy.png").exists()
    rows = json.loads((tmp_path / "results.json").read_text())["arms"]
    errors = {name: np.mean(rows[name]["model_error"]) for name in names}
    assert errors["dyna (lean preset)"] < errors["model: 3 updates an episode"] <= 1


def test_the_ladders_steps_lead_from_the_paper_to_tuned():
    """Each setting in which the presets differ belongs to one step."""
    paths = [path for step in STEPS.values() for path in step]
    counts = ("preset", "episodes", *PAPER.decided)  # the ladder has as many for all
    differ = [leaf.path for leaf in leaves(PAPER) if leaf.value != value_at(TUNED, leaf.path)]
    assert sorted(paths) == sorted(path for path in differ if path not in counts)


def test_a_rung_is_one_step_away_from_one_of_its_ends():
    study = LADDER.experiment()
    options = study.presets["paper"].resolved()
    table = {name: LADDER.setup(options, row) for name, row in ladder(options).items()}
    assert tuple(table) == options.arms and {"paper", "tuned", "model-free: tuned"} < table.keys()

    def apart(one, other):
        return {
            leaf.path
            for leaf in leaves(table[one])
            if leaf.path not in PAPER.decided and leaf.value != value_at(table[other], leaf.path)
        }

    for step, paths in STEPS.items():
        for end, rung in (("paper", f"paper with {step}"), ("tuned", f"tuned without {step}")):
            assert set() < apart(end, rung) <= {*paths, "dyna.dream_episodes"}
    ends = apart("paper", "tuned")
    assert ends == {path for step in STEPS.values() for path in step} | {"dyna.dream_episodes"}
    dreamed = {
        name: setup.dyna.dream_updates * setup.dyna.dream_episodes * setup.dyna.dream_steps
        for name, setup in table.items()
    }
    assert dreamed["paper"] == dreamed[f"paper with {SHORT}"] == 120
    assert (dreamed["tuned"], dreamed[f"tuned without {SHORT}"]) == (2000, 33 * 60)  # whole dreams


def test_a_model_free_agent_notices_every_step_that_it_is_played_with():
    options = LADDER.experiment().presets["paper"].resolved()
    rows = {name: row for name, row in ladder(options).items() if name.startswith("model-free: ")}
    setups = [LADDER.setup(options, row) for row in rows.values()]
    unseen = {"fake_updates": 0, "fake_capacity": 1, "fake_episodes": 1}
    agents = [(replace(agent_of(setup), **unseen), setup.hparams.agent) for setup in setups]
    assert len(rows) == 16 and all(one != other for one, other in combinations(agents, 2))


def test_all_updates_at_once_are_as_many_as_after_every_dream():
    config = study_arms.busy(DQNConfig(updates=2, fake_updates=3), DynaConfig(dream_updates=4))
    assert config.updates == 14


def test_every_lever_is_told_apart_from_the_preset():
    study = LEVERS.experiment()
    options = study.presets["lean"].resolved()
    made = {name: make() for name, make in study.arms(options).items()}
    base, *others = made.values()
    assert tuple(made) == options.arms and len(made) > 20
    assert all(other != base for other in others)

"""Every experiment's command line at its smallest, as it was typed at 30aa21d (see `renamed`).

Tests run some of them in their own process; run as a script this prints those that `.ci/run`
starts as a user does, in today's spelling. Where both run the same programs, the second finds them
compiled.
"""

import shlex

from renamed import respelled

CARTPOLE = [
    "--seeds", "2", "--episodes", "24", "--real-first", "4", "--model.hidden", "16",
    "--model-updates", "2", "--dream-episodes", "2",
]  # fmt: skip
READINGS = [
    "--seeds", "2", "--episodes", "101",
    "--arms", "model-free, learning rate 0.01", "true environment as the model",
]  # fmt: skip
ACCURACY = [
    "--seeds", "2", "--episodes", "105",
    "--arms", "dyna (paper preset)", "hidden layers of 4", "2 model updates an episode",
]  # fmt: skip
MAZE = [
    "--quick", "--seeds", "2", "--episodes", "52", "--size", "4", "--steps", "8",
    "--real-first", "30", "--model-updates", "1", "--model-batch", "4", "--model-widths", "4",
    "--dream-episodes", "2", "--dream-steps", "3", "--agent.updates", "1",
    "--agent.fake-updates", "1", "--agent.batch", "4",
]  # fmt: skip
MAZE_PLANNED = [
    "--shown-episodes", "2", "--mpc.candidates", "2", "--mpc.horizon", "2"
]  # fmt: skip
MAZE_MODEL = [
    "--part", "model", "--quick", "--seeds", "2", "--episodes", "6", "--stages", "2", "6",
    "--ablation-stage", "6", "--steps", "30", "--horizon", "10", "--held-out", "2",
    "--paper.updates", "3", "--lean.updates", "3", "--widths", "4", "4", "4", "--dense", "16",
    "--lean-widths", "4", "4",
]  # fmt: skip
PLANNING = [
    "--quick", "--seeds", "2", "--episodes", "6", "--grounds", "cartpole",
    "--sizes.runs", "2", "1", "--sizes.cartpole-episodes", "4", "--sizes.played", "1", "1",
    "--sizes.candidates", "4", "--sizes.simulations", "4",
]  # fmt: skip
PONG = [
    "--quick", "--seeds", "1", "--episodes", "21", "--steps", "12", "--real-first", "20",
    "--model-updates", "1", "--model-batch", "2", "--dream-episodes", "2", "--dream-steps", "2",
    "--hidden", "4", "--agent.updates", "1", "--agent.fake-updates", "1", "--agent.batch", "2",
    "--agent.fake-capacity", "16", "--widths", "2", "2", "2", "--dense", "8",
]  # fmt: skip
PONG_MODEL = [
    "--part", "model", "--quick", "--seeds", "1", "--episodes", "2", "--steps", "14",
    "--horizon", "3", "--held-out", "2", "--dreams", "2", "--hidden", "4",
    "--paper.updates", "2", "--paper.batch", "2", "--ours.updates", "2", "--ours.batch", "2",
]  # fmt: skip
ON_THE_ATARI = ["--game", "ale", "--frames", "rgb", "--policies", "mixed"]
PLANNERS = [
    "--mpc.candidates", "2", "--mpc.horizon", "2", "--mcts.simulations", "2",
    "--mcts-rollout", "2", "--shown-episodes", "2", "--cloning.updates", "2",
]  # fmt: skip
DATA = [
    "--seeds", "2", "--episodes", "8", "--transitions", "40", "--updates", "4",
    "--judged-episodes", "2",
]  # fmt: skip
MAZE_LEVERS = [
    "--seeds", "1", "--episodes", "30", "--size", "3", "--obstacles", "1", "--steps", "20"
]  # fmt: skip
FIG4 = ["--model", "paper", "--size", "11", "--steps", "21", "--episodes", "32"]

SMOKE = {
    "maze": ["maze", *MAZE, "--arms", "dyna"],
    "planning": ["planning", *PLANNING, "--arms", "mpc_init"],
    "pong-model": ["pong", *PONG_MODEL, *ON_THE_ATARI, "--arms", "adversarial", "ours"],
    "levers": [
        "cartpole_levers", "--seeds", "2", "--episodes", "10",
        "--arms", "one network, no disagreement",
    ],
}  # fmt: skip
"""What `.ci/run` starts: of every command a part that no test plays to its report, or in the Maze
one whose programs the tests have compiled.
"""

NET = SMOKE | {
    "cartpole-paper": ["cartpole", *CARTPOLE, "--arms", "model_free", "dyna"],
    "cartpole-lean": ["cartpole", "--preset", "lean", *CARTPOLE, "--arms", "model_free", "dyna"],
    "maze-model": ["maze", *MAZE_MODEL, "--arms", "paper", "lean"],
    "accuracy": ["cartpole_accuracy", *ACCURACY],
    "readings": ["cartpole_readings", *READINGS],
    "data": ["cartpole_data", *DATA],
    "pong": ["pong", *PONG, "--arms", "dyna_adversarial"],
    "cartpole-controls": ["cartpole", *CARTPOLE, "--arms", "placebo", "oracle"],
    "cartpole-lean-controls": [
        "cartpole", "--preset", "lean", *CARTPOLE, "--arms", "placebo", "oracle",
    ],
    "cartpole-planners": [
        "cartpole", *CARTPOLE, *PLANNERS,
        "--arms", "mpc", "mcts", "mpc_init", "mpc_init_dyna", "mpc_clone",
    ],
    "cartpole-details": [
        "cartpole", "--preset", "lean", *CARTPOLE, "--env-version", "v1", "--dream-start",
        "branched", "--dream-steps", "20", "--dream-noise", "0.1", "--authors-bug",
        "--forget-every", "7", "--terminal-share", "0.5", "--no-rest-when-safe", "--arms", "dyna",
    ],
    "maze-arms": [
        "maze", *MAZE, "--arms", "model_free", "dyna", "placebo", "oracle", "more_updates",
    ],
    "maze-planners": [
        "maze", *MAZE, *MAZE_PLANNED, "--mcts.simulations", "2", "--arms", "mpc", "mcts",
    ],
    "maze-imitating": ["maze", *MAZE, *MAZE_PLANNED, "--arms", "mpc_init"],
    "maze-lean": ["maze", "--preset", "lean", *MAZE, "--arms", "model_free", "dyna", "placebo"],
    "maze-levers": ["maze_levers", *MAZE_LEVERS, "--arms", "model-free", "model: L2 loss"],
    "maze-fig4": ["maze", *MAZE, *FIG4, "--model-loss", "l1", "--arms", "dyna"],
    "maze-losses": [
        "maze", *MAZE_MODEL, "--arms", "paper_l2", "paper_l1", "paper_reward", "lean_l2", "lean_l1",
    ],
    "pong-arms": [
        "pong", *PONG, "--arms", "model_free", "more_updates", "dyna", "dyna_l2", "placebo",
        "oracle",
    ],
    "pong-true": [
        "pong", *PONG, "--arms", "true_ball", "true_own", "true_opponent", "true_frames",
    ],
    "pong-lean": [
        "pong", "--preset", "lean", *PONG, "--seeds", "2", "--episodes", "40",
        "--stop-after-solved", "0", "--arms", "dyna",
    ],
    "pong-rgb": ["pong", *PONG, "--frames", "rgb", "--arms", "dyna_l2"],
    "pong-model-pure": ["pong", *PONG_MODEL, "--arms", "l2", "l1", "bce", "adversarial", "ours"],
    "planning-arms": [
        "planning", *PLANNING, "--sizes.runs", "1", "1", "--episodes", "8", "--arms", "dyna",
        "mpc_init_dyna", "mpc_clone, 20 model updates", "dyna, 20 model updates", "model_free",
        "mpc",
    ],
    "planning-maze": [
        "planning", *PLANNING, "--grounds", "maze", "--sizes.maze-episodes", "16", "--sizes.board",
        "3", "1", "5", "--sizes.far-candidates", "2", "--sizes.batch", "2", "--arms", "model_free",
    ],
}  # fmt: skip
"""What `tests/tools/same_curves.py` plays with two trees."""

LONG = {
    "readings-all": ["cartpole_readings", "--seeds", "1", "--episodes", "101"],
    "levers-all": ["cartpole_levers", "--seeds", "1", "--episodes", "12"],
    "accuracy-all": ["cartpole_accuracy", "--seeds", "1", "--episodes", "101"],
    "maze-levers-all": ["maze_levers", *MAZE_LEVERS],
}
"""Every row of every study; played where it is asked for by name."""

BLOCKS = dict.fromkeys(
    ("cartpole-paper", "cartpole-controls", "cartpole-planners", "accuracy", "readings", "data"), 2
)
"""Runs that were computed together, where that was more than one."""

NEW = {
    "maze-paper": [
        "maze", "--preset", "paper", "--quick", "--seeds", "1", "--episodes", "17", "--size", "7",
        "--steps", "13", "--obstacles", "1", "--coder-widths", "2", "2", "2", "--coder-dense", "8",
        "--convolutions", "2", "2", "2", "--dense", "8", "--reward-hidden", "4",
        "--dyna.model-updates", "1", "--agent.updates", "1", "--agent.fake-updates", "1",
        "--agent.fake-capacity", "100", "--arms", "dyna",
    ],
    "pong-paper": [
        "pong", "--preset", "paper", "--quick", "--seeds", "1", "--episodes", "21", "--steps", "12",
        "--dyna.num-real-first", "20", "--dyna.model-updates", "1", "--dyna.model-batch", "2",
        "--widths", "2", "2", "2", "--dense", "8", "--hidden", "4", "--convolutions", "2", "2", "2",
        "--agent-dense", "4", "--agent.updates", "1", "--agent.fake-updates", "1",
        "--agent.batch", "2", "--agent.fake-capacity", "16", "--arms", "dyna_l2",
    ],
    "catch": [
        "catch", "--quick", "--episodes", "24", "--rows", "5", "--dyna.num-real-first", "4",
        "--dyna.model-updates", "2", "--agent.updates", "2", "--agent.fake-updates", "2",
        "--arms", "dyna", "--sweep", "hparams.agent.learning_rate=0.001,0.002",
    ],
    "any": [
        "any", "--env", "gymnasium:CartPole-v1", "--seeds", "1", "--episodes", "8",
        "--hparams.env.max-steps", "30", "--dyna.num-real-first", "4", "--dyna.model-updates", "2",
        "--dyna.eval-every", "4", "--agent.fake-updates", "2", "--arms", "dyna",
    ],
}  # fmt: skip
"""What the old tree did not have, or measured otherwise."""

if __name__ == "__main__":
    today = {name: respelled(command) for name, command in SMOKE.items()} | NEW
    for name, command in today.items():
        print(name, shlex.join(command or []))

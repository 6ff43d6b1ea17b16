"""Dyna on frames as people write it, in PyTorch and NumPy, one environment, one seed and one step
at a time: DQN, a model of the frames, and fake episodes that are stepped together. The networks and
counts are those of `jaxdyna`'s Maze (`tuned`) and Pong (`paper`, arm `dyna_l2`); Pong is the real
Atari 2600's.

It is what `python -m jaxdyna.experiments.benchmark --what frames` is measured against.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import ale_py
import gymnasium
import numpy as np
import torch
from numpy_maze import NumpyMaze
from torch import Tensor, nn
from torch.nn import functional

FRAMES, STEPS, BATCH = 4, 200, 32


class AtariPong:
    """40x40 pixels of the field, four frames a step."""

    num_actions = 6

    def __init__(self, seed: int):
        gymnasium.register_envs(ale_py)
        self.env = gymnasium.make("ALE/Pong-v5", frameskip=4, repeat_action_probability=0.0)
        self.env.reset(seed=seed)

    def reset(self) -> np.ndarray:
        """The first frame of a game."""
        self.time = 0
        return self.env.reset()[0][34:194:4, ::4]

    def step(self, action: int) -> tuple[np.ndarray, float, bool]:
        """The frame, the reward, and whether the episode is over."""
        screen, reward, terminated, truncated, _ = self.env.step(action)
        self.time += 1
        return screen[34:194:4, ::4], reward, terminated or truncated or self.time >= STEPS


class Dueling(nn.Module):
    """Values of actions from their mean and what each is above it."""

    def forward(self, x: Tensor) -> Tensor:
        """``[N, 1 + actions]`` to ``[N, actions]``."""
        return x[:, :1] + x[:, 1:] - x[:, 1:].mean(1, keepdim=True)


def maze_values(actions: int) -> nn.Module:
    """Three convolutions and a normalised dense layer, from ``[N, 12, 16, 16]``."""
    return nn.Sequential(
        nn.Conv2d(12, 16, 2, stride=2), nn.ReLU(), nn.Conv2d(16, 16, 3, padding=1), nn.ReLU(),
        nn.Conv2d(16, 32, 3, padding=1), nn.ReLU(), nn.Flatten(), nn.Linear(32 * 64, 128),
        nn.LayerNorm(128), nn.ReLU(), nn.Linear(128, actions + 1), Dueling(),
    )  # fmt: skip


def pong_values(actions: int) -> nn.Module:
    """Three convolutions without padding and a dense layer, from ``[N, 12, 40, 40]``."""
    return nn.Sequential(
        nn.Conv2d(12, 8, 12, stride=4, bias=False), nn.BatchNorm2d(8), nn.ReLU(),
        nn.Conv2d(8, 16, 3, bias=False), nn.BatchNorm2d(16), nn.ReLU(),
        nn.Conv2d(16, 16, 3, bias=False), nn.BatchNorm2d(16), nn.ReLU(),
        nn.Flatten(), nn.Linear(16 * 16, 128), nn.ReLU(), nn.Linear(128, actions),
    )  # fmt: skip


class MazeModel(nn.Module):
    """Two 3x3 convolutions, the action's factor after the first; the reward as a sum over cells of
    the next picture. ``rate`` is Adam's.
    """

    rate, betas = 3e-3, (0.9, 0.999)

    def __init__(self, actions: int):
        super().__init__()
        self.first, self.second = nn.Conv2d(13, 32, 3, padding=1), nn.Conv2d(32, 32, 3, padding=1)
        self.action, self.picture = nn.Linear(actions, 32), nn.Conv2d(32, 3, 1)
        self.earned = nn.Sequential(nn.Conv2d(3, 16, 1), nn.ReLU(), nn.Conv2d(16, 1, 1, bias=False))

    def forward(self, stack: Tensor, action: Tensor) -> Tensor:
        """Log odds ``[N, 3, 16, 16]`` from ``[N, 12, 16, 16]`` and one-hot actions."""
        x = self.first(torch.cat([stack, torch.ones_like(stack[:, :1])], dim=1))
        x = torch.relu(x * self.action(action)[:, :, None, None])
        return self.picture(torch.relu(self.second(x)))

    def loss(self, stack: Tensor, action: Tensor, reward: Tensor, truth: Tensor) -> Tensor:
        """The cross-entropy of the pixels, and the squared error of the reward."""
        odds, earned = self(stack, action), self.earned(truth)
        pixels = functional.binary_cross_entropy_with_logits(odds, truth, reduction="none")
        error = (earned.sum((1, 2, 3)) - reward).square() + 0.1 * earned.abs().sum((1, 2, 3))
        return (pixels.sum((1, 2, 3)) + error).mean()

    def predict(self, stack: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The next picture in [0, 1], and the reward ``[N]``."""
        frame = (self(stack, action) > 0).float()
        return frame, self.earned(frame).sum((1, 2, 3))


class PongModel(nn.Module):
    """The paper's Fig. 4 on patches of 4x4 pixels, the reward off its joint features."""

    rate, betas = 2e-3, (0.5, 0.999)

    def __init__(self, actions: int):
        super().__init__()
        self.encoder = nn.Sequential(
            nn.PixelUnshuffle(4), nn.Conv2d(12 * 16, 32, 4), nn.ReLU(),
            nn.Conv2d(32, 32, 3), nn.BatchNorm2d(32), nn.ReLU(),
            nn.Conv2d(32, 32, 3), nn.BatchNorm2d(32), nn.ReLU(),
            nn.Flatten(), nn.Linear(288, 512, bias=False), nn.BatchNorm1d(512),
        )  # fmt: skip
        self.action = nn.Linear(actions, 512, bias=False)
        self.decoder = nn.Sequential(
            nn.Linear(512, 288), nn.BatchNorm1d(288), nn.ReLU(), nn.Unflatten(1, (32, 3, 3)),
            nn.ConvTranspose2d(32, 32, 3), nn.BatchNorm2d(32), nn.ReLU(),
            nn.ConvTranspose2d(32, 32, 3), nn.BatchNorm2d(32), nn.ReLU(),
            nn.ConvTranspose2d(32, 3 * 16, 4), nn.PixelShuffle(4),
        )  # fmt: skip
        self.points = nn.Linear(512, 2)

    def forward(self, stack: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The raw picture ``[N, 3, 40, 40]`` and the reward ``[N]``."""
        joint = self.encoder(stack) * self.action(action)
        won, lost = self.points(joint).sigmoid().unbind(1)
        return self.decoder(joint), won - lost

    def loss(self, stack: Tensor, action: Tensor, reward: Tensor, truth: Tensor) -> Tensor:
        """Half the squared error of the pixels, and five times the reward's."""
        raw, said = self(stack, action)
        pixels = 0.5 * (raw - truth).square().sum((1, 2, 3))
        return (pixels + 5.0 * (said - reward).square()).mean()

    def predict(self, stack: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The next picture in [0, 1], and the reward ``[N]``."""
        raw, reward = self(stack, action)
        return raw.clamp(0, 1), reward


@dataclass(frozen=True)
class Settings:
    """Of a world: its parts, counts and rates."""

    env: Callable[[int], Any]
    values: Callable[[int], nn.Module]
    model: Callable[[int], Any]
    model_updates: int
    updates: int
    fake_updates: int
    dream_episodes: int
    dream_steps: int
    loss: Callable[[Tensor], Tensor]
    capacity: int
    fake_capacity: int
    double: bool
    discount: float
    target_rate: float
    priority: float
    learning_rate: float = 1e-3
    epsilon: float = 0.3


def huber(error: Tensor) -> Tensor:
    """Linear beyond 1."""
    return functional.huber_loss(error, torch.zeros_like(error), reduction="none")


MAZE = Settings(
    NumpyMaze, maze_values, MazeModel, model_updates=50, updates=50, fake_updates=400,
    dream_episodes=400, dream_steps=5, loss=huber, capacity=100_000, fake_capacity=64_000,
    double=True, discount=0.95, target_rate=0.02, priority=0.6,
)  # fmt: skip
PONG = Settings(
    AtariPong, pong_values, PongModel, model_updates=64, updates=200, fake_updates=200,
    dream_episodes=1, dream_steps=200, loss=lambda error: 0.5 * error.square(), capacity=40_000,
    fake_capacity=40_000, double=False, discount=0.99, target_rate=0.01, priority=0.0,
)  # fmt: skip


class Replay:
    """The newest transitions; uniform, or by priority (Schaul et al. 2016)."""

    def __init__(self, capacity: int, exponent: float, rng: np.random.Generator):
        self.capacity, self.exponent, self.rng = capacity, exponent, rng
        self.data: list[tuple] = []
        self.priority, self.added = np.zeros(capacity), 0

    def add(self, *transition: Any) -> None:
        """``obs, action, reward, next_obs``, at the highest priority that there is."""
        place = self.added % self.capacity
        self.data[place : place + 1] = [transition]
        self.priority[place] = self.priority[: len(self.data)].max() or 1.0
        self.added += 1

    def sample(self, count: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Places, how often each is drawn compared with a uniform draw, and the columns."""
        size = len(self.data)
        share = np.full(size, 1 / size)
        if self.exponent:
            share = self.priority[:size] / self.priority[:size].sum()
            places = self.rng.choice(size, count, p=share)
        else:
            places = self.rng.integers(size, size=count)
        columns = zip(*(self.data[place] for place in places), strict=True)
        return places, share[places] * size, [np.stack(column) for column in columns]

    def reprioritise(self, places: np.ndarray, errors: np.ndarray) -> None:
        """By new TD errors."""
        self.priority[places] = (np.abs(errors) + 1e-3) ** self.exponent


class Learner:
    """One run."""

    def __init__(self, settings: Settings, seed: int = 0):
        torch.manual_seed(seed)
        self.settings, self.rng, self.env = (
            settings,
            np.random.default_rng(seed),
            settings.env(seed),
        )
        self.actions = self.env.num_actions
        self.values, self.target = (settings.values(self.actions) for _ in range(2))
        self.target.load_state_dict(self.values.state_dict())
        self.model = settings.model(self.actions)
        self.optimizer = torch.optim.Adam(self.values.parameters(), lr=settings.learning_rate)
        self.model_optimizer = torch.optim.Adam(
            self.model.parameters(), lr=self.model.rate, betas=self.model.betas
        )
        replay = partial(Replay, exponent=settings.priority, rng=self.rng)
        self.real, self.fake = replay(settings.capacity), replay(settings.fake_capacity)

    @torch.no_grad()
    def act(self, obs: Tensor) -> np.ndarray:
        """Actions ``[N]`` from stacks in [0, 1], some of them exploratory; beside Double DQN by the
        target network.
        """
        network = self.target if self.settings.double else self.values
        explores = self.rng.random(len(obs)) < self.settings.epsilon
        random = self.rng.integers(self.actions, size=len(obs))
        return np.where(explores, random, network(obs).argmax(1).numpy())

    def real_episode(self) -> None:
        """Plays one and keeps it."""
        obs, over = np.tile(self.env.reset().transpose(2, 0, 1), (FRAMES, 1, 1)), False
        while not over:
            action = int(self.act(scaled(obs[None]))[0])
            frame, reward, over = self.env.step(action)
            next_obs = np.concatenate([obs[3:], frame.transpose(2, 0, 1)])
            self.real.add(obs, action, np.float32(reward), next_obs)
            obs = next_obs

    def update_model(self) -> None:
        """A gradient step on a batch of real transitions."""
        rows = self.rng.integers(len(self.real.data), size=BATCH)
        columns = zip(*(self.real.data[row] for row in rows), strict=True)
        obs, action, reward, next_obs = (torch.as_tensor(np.stack(one)) for one in columns)
        done = functional.one_hot(action, self.actions).float()
        loss = self.model.loss(scaled(obs), done, reward, scaled(next_obs[:, -3:]))
        self.model_optimizer.zero_grad()
        loss.backward()
        self.model_optimizer.step()

    @torch.no_grad()
    def dream(self) -> None:
        """Fake episodes from anywhere in real ones, stepped together."""
        rows = self.rng.integers(len(self.real.data), size=self.settings.dream_episodes)
        obs = np.stack([self.real.data[row][0] for row in rows])
        self.model.eval()
        for _ in range(self.settings.dream_steps):
            stack = scaled(obs)
            action = self.act(stack)
            done = functional.one_hot(torch.as_tensor(action), self.actions).float()
            frame, reward = self.model.predict(stack, done)
            frame = (255 * frame).round().to(torch.uint8).numpy()
            next_obs = np.concatenate([obs[:, 3:], frame], axis=1)
            for transition in zip(obs, action, reward.numpy(), next_obs, strict=True):
                self.fake.add(*transition)
            obs = next_obs
        self.model.train()

    def update_values(self) -> None:
        """A gradient step of DQN on a batch that is half fake, once there are dreams."""
        settings = self.settings
        fakes = self.rng.binomial(BATCH, 0.5) if self.fake.data else 0
        counts = {self.real: BATCH - fakes, self.fake: fakes}
        drawn = {replay: replay.sample(count) for replay, count in counts.items() if count}
        columns = zip(*(columns for _, _, columns in drawn.values()), strict=True)
        obs, action, reward, next_obs = (torch.as_tensor(np.concatenate(one)) for one in columns)
        with torch.no_grad():
            after = scaled(next_obs)
            next_values = self.target(after)
            choice = self.values(after) if settings.double else next_values
            best = next_values.gather(1, choice.argmax(1, keepdim=True))[:, 0]
            goal = reward + settings.discount * best
        error = goal - self.values(scaled(obs)).gather(1, action[:, None])[:, 0]
        often = np.concatenate([often for _, often, _ in drawn.values()])
        weight = torch.as_tensor(often, dtype=torch.float32) ** -0.4
        loss = (weight / weight.max() * settings.loss(error)).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.values.parameters(), strict=True)
            for old, new in pairs:
                old.lerp_(new, settings.target_rate)
        if settings.priority:
            errors = np.split(error.detach().numpy(), np.cumsum([c for c in counts.values() if c]))
            for (replay, (places, _, _)), each in zip(drawn.items(), errors, strict=False):
                replay.reprioritise(places, each)

    def learn(self, updates: int) -> None:
        """So many gradient steps of DQN."""
        for _ in range(updates):
            self.update_values()

    def train_model(self) -> None:
        """The model's gradient steps after a real episode."""
        for _ in range(self.settings.model_updates):
            self.update_model()

    def episode(self) -> None:
        """A real episode, and all that is learned after it."""
        self.real_episode()
        self.learn(self.settings.updates)
        self.train_model()
        self.dream()
        self.learn(self.settings.fake_updates)


def scaled(picture: Any) -> Tensor:
    """Bytes as numbers in [0, 1]."""
    return torch.as_tensor(picture).float() / 255

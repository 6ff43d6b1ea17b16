"""The arms `model_free` and `dyna` of CartPole's `tuned` preset as people write them: PyTorch and
Gymnasium, one environment, one step and one seed at a time. Dreams too are stepped one by one, or
all those of an update together (``batched``).

It is what `python -m jaxdyna.experiments.benchmark` is measured against. Alone,
``python docs/examples/torch_cartpole.py 10``, it says how soon so many runs of each arm solve.
"""

import random
import sys

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.nn.utils.rnn import pad_sequence

STEPS, DISCOUNT, FIRST_DREAM = 200, 0.99, 100
MODEL_UPDATES, MODEL_BATCH, SPREAD = 60, 16, 3.0
DREAM_UPDATES, DREAM_EPISODES, ENDS_ABOVE = 2, 8, 0.1
WINDOW, SOLVED = 100, 195.0


class Moments:
    """Running mean and standard deviation of vectors ``[size]``."""

    def __init__(self, size: int):
        self.mean, self.variance, self.batches = torch.zeros(size), torch.ones(size), 0

    def update(self, values: Tensor) -> None:
        """Takes in a batch ``[N, size]``; the first 200 count alike, later ones move it by
        1/200.
        """
        self.batches += 1
        rate = 1 / min(self.batches, 200)
        moved = values.mean(0) - self.mean
        self.mean = self.mean + rate * moved
        self.variance = (1 - rate) * (self.variance + rate * moved**2)
        self.variance = self.variance + rate * values.var(0, correction=0)

    @property
    def scale(self) -> Tensor:
        """What maps `SPREAD` standard deviations to 1."""
        return SPREAD * self.variance.sqrt()


class Model:
    """Predicts the change of the state, the reward and the end."""

    def __init__(self) -> None:
        self.network = nn.Sequential(
            nn.Linear(5, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 6)
        )
        for layer in self.network[::2]:
            nn.init.zeros_(layer.bias)
        self.optimizer = torch.optim.SGD(self.network.parameters(), lr=0.01)
        self.inputs, self.changes = Moments(4), Moments(4)

    def __call__(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The scaled change ``[N, 4]``, the reward and the end's log odds ``[N]``."""
        scaled = (obs - self.inputs.mean) / self.inputs.scale
        output = self.network(torch.cat([scaled, action[:, None]], dim=1))
        return output[:, :4], output[:, 4], output[:, 5]

    @torch.no_grad()
    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The next states ``[N, 4]``, rewards and probabilities of the end ``[N]``."""
        change, reward, logit = self(obs, action)
        return obs + change * self.changes.scale + self.changes.mean, reward, logit.sigmoid()

    def update(self, batch: list[tuple]) -> None:
        """A gradient step on transitions, of the loss of Eq. 1."""
        columns = [torch.as_tensor(np.array(one, np.float32)) for one in zip(*batch, strict=True)]
        obs, action, reward, next_obs, terminated = columns
        self.inputs.update(obs)
        self.changes.update(next_obs - obs)
        target = (next_obs - obs - self.changes.mean) / self.changes.scale
        change, predicted, logit = self(obs, action)
        loss = (change - target).square().sum() + (predicted - reward).square().sum()
        loss = loss + binary_cross_entropy_with_logits(logit, terminated, reduction="sum")
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


class Run:
    """A run of one seed; ``batched`` steps all fake episodes of an update together."""

    def __init__(self, seed: int, batched: bool = False, ends_above: float = ENDS_ABOVE):
        random.seed(seed)
        torch.manual_seed(seed)
        self.batched, self.ends_above, self.seed = batched, ends_above, seed
        self.env = gymnasium.make("CartPole-v1", max_episode_steps=STEPS)
        self.env.reset(seed=seed)
        self.policy = nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 2))
        for layer in self.policy[::2]:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="linear")  # LeCun's
            nn.init.zeros_(layer.bias)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=0.01)
        self.model = Model()
        self.replay: list[tuple] = []
        self.starts: list[np.ndarray] = []

    def act(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Actions and their log probabilities ``[N]`` in states ``[N, 4]``."""
        choice = Categorical(logits=self.policy(obs), validate_args=False)
        action = choice.sample()
        return action, choice.log_prob(action)

    def real_episode(self) -> int:
        """Plays and keeps an episode and learns the policy from it; returns its length."""
        obs, _ = self.env.reset()
        self.starts.append(obs)
        log_probs, rewards, over = [], [], False
        while not over:
            action, log_prob = self.act(torch.as_tensor(obs)[None])
            next_obs, reward, terminated, truncated, _ = self.env.step(action.item())
            self.replay.append((obs, action.item(), reward, next_obs, terminated))
            log_probs.append(log_prob[0])
            rewards.append(reward)
            obs, over = next_obs, terminated or truncated
        self.learn([torch.stack(log_probs)], [torch.tensor(rewards)])
        return len(rewards)

    def train_model(self) -> None:
        """A gradient step on a batch of all that was kept."""
        self.model.update(random.choices(self.replay, k=MODEL_BATCH))

    @torch.no_grad()
    def dream(self, count: int, longest: int = STEPS) -> tuple[Tensor, ...]:
        """States ``[N, T, 4]``, actions and rewards ``[N, T]`` of fake episodes, stepped together,
        and which of these steps there are.
        """
        obs = torch.as_tensor(np.stack(random.choices(self.starts, k=count)))
        alive, steps = torch.ones(count, dtype=torch.bool), []
        while len(steps) < longest and alive.any():
            action = self.policy(obs).softmax(1).multinomial(1)[:, 0]
            next_obs, reward, end = self.model.predict(obs, action)
            steps.append((obs, action, reward, alive))
            obs, alive = next_obs, alive & (end <= self.ends_above)
        return tuple(torch.stack(one, dim=1) for one in zip(*steps, strict=True))

    def learn_from_dreams(self) -> int:
        """An update of the policy on fake episodes; returns the number of fake steps."""
        counts = [DREAM_EPISODES] if self.batched else [1] * DREAM_EPISODES
        log_probs, rewards = [], []
        for obs, action, reward, there in map(self.dream, counts):
            log_prob = Categorical(logits=self.policy(obs), validate_args=False).log_prob(action)
            for row, last in enumerate(there.sum(1).tolist()):
                log_probs.append(log_prob[row, :last])
                rewards.append(reward[row, :last])
        self.learn(log_probs, rewards)
        return sum(map(len, rewards))

    def learn(self, log_probs: list[Tensor], rewards: list[Tensor]) -> None:
        """A step of REINFORCE on episodes, their returns less the mean, at the same step, of those
        that got there.
        """
        valid = pad_sequence([torch.ones(len(one)) for one in rewards], batch_first=True)
        reward = pad_sequence(rewards, batch_first=True).numpy()
        returns, following = np.zeros_like(reward), np.zeros(len(reward), np.float32)
        for step in reversed(range(reward.shape[1])):
            following = reward[:, step] + DISCOUNT * following
            returns[:, step] = following
        advantage = torch.as_tensor(returns)
        if len(rewards) > 1:
            advantage = advantage - (advantage * valid).sum(0) / valid.sum(0)
        known = advantage[valid > 0]
        advantage = (advantage - known.mean()) / (known.std(correction=0) + 1e-6)
        log_prob = pad_sequence(log_probs, batch_first=True)
        loss = -(valid * advantage * log_prob).sum() / len(rewards)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    def episode(self, number: int, dyna: bool = True) -> int:
        """A real episode, numbered from 0, and what is learned after it; returns its length."""
        length = self.real_episode()
        for _ in range(MODEL_UPDATES if dyna else 0):
            self.train_model()
        for _ in range(DREAM_UPDATES if dyna and number + 1 >= FIRST_DREAM else 0):
            self.learn_from_dreams()
        return length


def episodes_to_solve(
    seed: int, episodes: int = 1000, dyna: bool = True, batched: bool = True
) -> int | None:
    """Real episodes until the mean return of the last 100 reaches 195; None where it does not."""
    run, lengths = Run(seed, batched), []
    for number in range(episodes):
        lengths.append(run.episode(number, dyna))
        if len(lengths) >= WINDOW and np.mean(lengths[-WINDOW:]) >= SOLVED:
            return len(lengths)
    return None


if __name__ == "__main__":
    torch.set_num_threads(1)
    for seed in range(int(sys.argv[1])):
        for dyna in (False, True):
            found = episodes_to_solve(seed, dyna=dyna)
            print("dyna" if dyna else "model_free", seed, found, flush=True)

"""
LAC in one file, to read the algorithm from top to bottom: PyTorch and Gymnasium, and nothing of Stable-Baselines3.

    python examples/lac_single_file.py  # the linear problem, in a minute or two

Its update is that of ``sb3_lac.LAC`` where no reward is positive, number for number, as a test shows. docs/how_lac_works.md
says why each part is as it is. What is left out: checks, saving, logging, positive rewards, n steps, images.
"""

from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn


@dataclass(frozen=True)
class Settings:
    learning_rate: float = 3e-4
    gamma: float = 0.99  # the discount
    tau: float = 0.005  # share by which targets follow
    alpha3: float = 1.0  # share of the cost by which L has to decrease in each step
    lambda_min: float = 1e-4
    lambda_max: float = 1.0
    n_critics: int = 2
    width: int = 64  # of the two hidden layers
    batch_size: int = 256


class Batch(NamedTuple):
    """Transitions, one a row. A time limit is no termination: the task would have gone on."""

    observations: th.Tensor
    actions: th.Tensor  # in [-1, 1]
    next_observations: th.Tensor
    costs: th.Tensor  # minus the rewards
    terminated: th.Tensor


def two_layers(n_inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


class Actor(nn.Module):
    """A Gaussian whose samples are squashed into [-1, 1], as in SAC."""

    def __init__(self, n_observations: int, n_actions: int, width: int):
        super().__init__()
        self.latent_pi = two_layers(n_observations, width)
        self.mu = nn.Linear(width, n_actions)
        self.log_std = nn.Linear(width, n_actions)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """The mean action, which is that of the trained policy."""
        return th.tanh(self.mu(self.latent_pi(observations)))

    def sample(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Actions for exploration, and the logarithm of their density."""
        latent = self.latent_pi(observations)
        gaussian = th.distributions.Normal(self.mu(latent), self.log_std(latent).clamp(-20.0, 2.0).exp())
        unsquashed = gaussian.rsample()
        actions = th.tanh(unsquashed)
        return actions, (gaussian.log_prob(unsquashed) - th.log(1.0 - actions.square() + 1e-6)).sum(dim=1)


class Critic(nn.Module):
    """
    Networks that learn a root ``f`` of what ``L``, the discounted sum of costs, is above a floor: all levels of the cost count
    then, from that of a crash to that of a loop at rest.
    """

    def __init__(self, n_inputs: int, width: int, n_critics: int):
        super().__init__()
        networks = [two_layers(n_inputs, width).append(nn.Linear(width, 1)) for _ in range(n_critics)]
        self.networks = nn.ModuleList(networks)
        self.floor = nn.Buffer(th.zeros(1))  # follows the lowest value
        self.scale = nn.Buffer(th.zeros(1))  # follows a tenth of the mean distance from the floor

    def forward(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Roots of shape (critics, rows, 1). The largest one is the most careful."""
        inputs = th.cat([observations, actions], dim=1)
        return th.stack([network(inputs) for network in self.networks])


def distance(f: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """The square root of the value above the floor, with its sign: like a norm where the value is like a square."""
    return f * f.abs() / (scale + f.abs()).clamp(min=1e-38)


def value(f: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """The value above the floor."""
    return distance(f, scale) * distance(f, scale).abs()


def root(above: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """What a critic learns of a value above the floor: a square root where it is large, and a fourth root near the floor."""
    size = above.abs().sqrt()
    return above.sign() * (size + (size * (size + 4.0 * scale)).sqrt()) / 2.0


class LAC:
    def __init__(self, n_observations: int, n_actions: int, settings: Settings):
        self.settings = settings
        self.actor = Actor(n_observations, n_actions, settings.width)
        self.critic = Critic(n_observations + n_actions, settings.width, settings.n_critics)
        self.critic_target = deepcopy(self.critic).requires_grad_(False)
        # Weights of the cost and of the entropy in the loss of the actor: multipliers of two constraints, as logarithms
        self.log_lambda = th.zeros(1, requires_grad=True)
        self.log_ent_coef = th.full((1,), 0.1).log().requires_grad_()  # learned from 0.1 on
        self.target_entropy = -float(n_actions)
        learned = (self.actor.parameters(), self.critic.parameters(), [self.log_lambda], [self.log_ent_coef])
        self.optimizers = [th.optim.Adam(parameters, lr=settings.learning_rate) for parameters in learned]

    def update(self, batch: Batch) -> dict[str, float]:
        settings = self.settings
        actions_pi, log_prob = self.actor.sample(batch.observations)

        # 1. The critics learn the root of y = c + gamma L'(s', a'), with the mean action a' and the target critic L'
        with th.no_grad():
            next_actions = self.actor(batch.next_observations)
            next_roots = self.critic_target(batch.next_observations, next_actions).amax(dim=0)
            next_values = (value(next_roots, self.critic_target.scale) + self.critic_target.floor).clamp(min=0.0)
            targets = batch.costs + settings.gamma * (1.0 - batch.terminated) * next_values
            self.critic.floor.lerp_(targets.min(), settings.tau)
            above = targets - self.critic.floor
            first = self.critic.scale == 0.0
            self.critic.scale.lerp_(0.1 * above.abs().sqrt().mean(), 1.0 if first else settings.tau)
            scale = self.critic.scale
            target_roots = root(above, scale)
        roots = self.critic(batch.observations, batch.actions)
        critic_loss = 0.5 * (roots - target_roots).square().mean(dim=1).sum()

        # 2. By how much the decrease condition L(s', a') <= L(s, a) - alpha3 c is violated, where the episode goes on
        with th.no_grad():
            next_root = self.critic(batch.next_observations, next_actions).amax(dim=0)
            allowed = root(value(roots.amax(dim=0), scale) - settings.alpha3 * batch.costs, scale)
            difference = distance(next_root, scale) - distance(allowed, scale)
            going_on = 1.0 - batch.terminated
            violation = (going_on * difference).sum() / going_on.sum().clamp(min=1.0)

        # 3. The actor lowers the distance, and keeps its entropy
        objective = distance(self.critic(batch.observations, actions_pi).amax(dim=0), scale).mean()
        lambda_, ent_coef = self.log_lambda.detach().exp(), self.log_ent_coef.detach().exp()
        actor_loss = lambda_ * objective + ent_coef * log_prob.mean()

        # 4. A multiplier grows while its constraint is violated
        lambda_loss = -self.log_lambda * violation
        ent_coef_loss = -self.log_ent_coef * (log_prob.mean().detach() + self.target_entropy)
        losses = {"actor": actor_loss, "critic": critic_loss, "lambda": lambda_loss, "ent_coef": ent_coef_loss}
        for loss, optimizer in zip(losses.values(), self.optimizers, strict=True):
            optimizer.zero_grad()
            loss.backward(inputs=optimizer.param_groups[0]["params"])  # the critic must not learn from the actor's
        for optimizer in self.optimizers:
            optimizer.step()
        with th.no_grad():
            self.log_lambda.clamp_(np.log(settings.lambda_min), np.log(settings.lambda_max))
            # 5. The target critic follows, and its floor too
            for name, tensor in self.critic_target.state_dict().items():
                tensor.lerp_(self.critic.state_dict()[name], settings.tau)
            self.critic_target.scale.copy_(self.critic.scale)
        return {name: loss.item() for name, loss in losses.items()}


@th.no_grad()
def mean_cost(agent: LAC, env: gym.Env, n_episodes: int = 20, seed: int = 10_000) -> float:
    """Cost per step of the mean action, on episodes of their own."""
    costs = []
    for episode in range(n_episodes):
        observation, done = env.reset(seed=seed + episode)[0], False
        while not done:
            action = agent.actor(th.as_tensor(observation)[None])[0].numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            costs.append(-float(reward))
            done = terminated or truncated
    return float(np.mean(costs))


def main(env_id: str = "sb3_lac:LinearCost-v0", n_steps: int = 5_000, learning_starts: int = 100, seed: int = 0) -> float:
    """Train, and return the cost per step of the policy."""
    th.manual_seed(seed)
    rng = np.random.default_rng(seed)
    env, eval_env = gym.make(env_id), gym.make(env_id)  # actions in [-1, 1]
    agent = LAC(env.observation_space.shape[0], env.action_space.shape[0], Settings())
    transitions = []
    observation, _ = env.reset(seed=seed)
    for step in range(n_steps):
        if step < learning_starts:
            action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        else:
            with th.no_grad():
                action = agent.actor.sample(th.as_tensor(observation)[None])[0][0].numpy()
        next_observation, reward, terminated, truncated, _ = env.step(action)
        transitions.append((observation, action, next_observation, [-float(reward)], [float(terminated)]))
        observation = env.reset()[0] if terminated or truncated else next_observation
        if step >= learning_starts:
            drawn = [transitions[row] for row in rng.integers(len(transitions), size=agent.settings.batch_size)]
            agent.update(Batch(*(th.as_tensor(np.array(column), dtype=th.float32) for column in zip(*drawn, strict=True))))
        if (step + 1) % 1_000 == 0:
            print(f"{step + 1} steps: the mean action costs {mean_cost(agent, eval_env):.3f} per step")
    return mean_cost(agent, eval_env)


if __name__ == "__main__":
    th.set_num_threads(1)  # the networks are small
    main()

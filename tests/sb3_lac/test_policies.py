import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_lac import LAC, LyapunovPolicy, MlpPolicy, PublishedLAC


class BatchNormDropoutExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=observation_space.shape[0])
        self.batch_norm = nn.BatchNorm1d(self.features_dim)

    def forward(self, observations):
        return nn.functional.dropout(self.batch_norm(observations), training=self.training)


def test_targets_start_as_copies_and_stay_in_eval_mode(make_model):
    model = make_model(n_collect=0, algorithm=PublishedLAC)
    for online, target in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        assert online is not target
        for parameter, target_parameter in zip(online.parameters(), target.parameters(), strict=True):
            assert parameter is not target_parameter and th.equal(parameter, target_parameter)
    model.policy.set_training_mode(True)
    assert model.actor.training and model.critic.training
    assert not model.actor_target.training and not model.critic_target.training


def test_batch_norm_and_dropout_work_in_training_only(make_model, train_metrics):
    model = make_model(n_collect=80, gradient_steps=0, policy_kwargs={"features_extractor_class": BatchNormDropoutExtractor})
    batch_norm_stats = get_parameters_by_name(model.policy, ["running_"])
    statistics = [tensor.clone() for tensor in batch_norm_stats]
    obs = np.ones(2, dtype=np.float32)
    actions = [model.predict(obs, deterministic=True)[0] for _ in range(5)]
    assert all(np.array_equal(action, actions[0]) for action in actions)
    assert np.ptp(model.policy.predict_lyapunov(np.ones((100, 2), np.float32), np.zeros((100, 2), np.float32))) < 1e-5
    # Neither collecting transitions nor predicting has changed the statistics
    model.learn(10, reset_num_timesteps=False)
    assert all(th.equal(before, after) for before, after in zip(statistics, batch_norm_stats, strict=True))
    train_metrics(model)
    assert not any(th.equal(before, after) for before, after in zip(statistics, batch_norm_stats, strict=True))


@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_shared_features_extractor_is_trained_by_the_actor_only(make_model, train_metrics, share_features_extractor):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = make_model(
        env,
        n_collect=5,
        learning_starts=5,
        buffer_size=10,
        batch_size=4,
        policy="CnnPolicy",
        policy_kwargs={"share_features_extractor": share_features_extractor, "features_extractor_kwargs": {"features_dim": 8}},
    )
    assert (model.actor.features_extractor is model.critic.features_extractor) == share_features_extractor
    assert model.critic_target.features_extractor is not model.actor.features_extractor
    n_optimized = sum(len(group["params"]) for group in model.critic.optimizer.param_groups)
    n_features = len(list(model.critic.features_extractor.parameters()))
    assert n_optimized == len(list(model.critic.parameters())) - (n_features if share_features_extractor else 0)
    before = [parameter.clone() for parameter in model.actor.features_extractor.parameters()]
    train_metrics(model)
    after = model.actor.features_extractor.parameters()
    assert any(not th.equal(old, new) for old, new in zip(before, after, strict=True))


def test_policy_keeps_all_arguments_when_saved_and_loaded(make_model, tmp_path):
    policy_kwargs = {"net_arch": {"pi": [8], "qf": [12]}, "n_critics": 3, "share_features_extractor": True}
    policy = make_model(n_collect=0, use_sde=True, policy_kwargs=policy_kwargs).policy
    policy.save(tmp_path / "policy.pkl")
    loaded = LyapunovPolicy.load(tmp_path / "policy.pkl", device="cpu")
    assert (policy.actor_kwargs, policy.critic_kwargs) == (loaded.actor_kwargs, loaded.critic_kwargs)
    assert loaded.actor.features_extractor is loaded.critic.features_extractor
    for name, tensor in policy.state_dict().items():
        assert th.equal(tensor, loaded.state_dict()[name])


def test_optimizer_is_chosen_by_the_user(make_model):
    for policy_kwargs, kind, fused in (
        ({}, th.optim.Adam, True),
        ({"optimizer_kwargs": {"foreach": True}}, th.optim.Adam, False),
        ({"optimizer_class": th.optim.SGD}, th.optim.SGD, None),
    ):
        optimizer = make_model(n_collect=0, policy_kwargs=policy_kwargs).policy.critic.optimizer
        assert type(optimizer) is kind and (fused is None or bool(optimizer.defaults["fused"]) == fused)


@pytest.mark.parametrize("name", ["actor", "critic", "first layers"])
def test_what_is_frozen_stays_as_it_is(name, make_model, train_metrics):
    model = make_model()
    # It has gradients of an earlier update
    train_metrics(model)
    layers = nn.ModuleList([model.actor.latent_pi, model.critic.lyapunov_networks[0]])
    frozen, free = {
        "actor": (model.actor, model.critic),
        "critic": (model.critic, model.actor),
        "first layers": (nn.ModuleList(net[0] for net in layers), nn.ModuleList(net[2] for net in layers)),
    }[name]
    frozen.requires_grad_(False)
    before = [[parameter.clone() for parameter in network.parameters()] for network in (frozen, free)]
    train_metrics(model, gradient_steps=2)
    assert all(th.equal(*pair) for pair in zip(before[0], frozen.parameters(), strict=True))
    assert not any(th.equal(*pair) for pair in zip(before[1], free.parameters(), strict=True))


class Einsum(BaseFeaturesExtractor):
    """A layer whose gradient has the layout of the transposed weight, and a parameter that nothing depends on."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=8)
        self.weight = nn.Parameter(th.randn(8, 48, generator=th.Generator().manual_seed(0)))
        self.unused = nn.Parameter(th.ones(3))

    def forward(self, observations):
        return th.einsum("bi,oi->bo", observations, self.weight)


def test_fused_optimizer_updates_layers_of_any_memory_layout(make_model, make_env, train_metrics):
    policies = []
    for fused in (True, False):
        policy_kwargs = {"features_extractor_class": Einsum, "optimizer_kwargs": {"fused": fused}}
        model = make_model(make_env(n_dim=48), policy_kwargs=policy_kwargs, learning_rate=1e-2)
        train_metrics(model, gradient_steps=2)
        policies.append(model.policy)
    for module in ("actor", "critic"):
        expected = dict(getattr(policies[1], module).named_parameters())
        for name, parameter in getattr(policies[0], module).named_parameters():
            th.testing.assert_close(parameter, expected[name], rtol=0, atol=1e-5, msg=f"{module}.{name}")
            if name.endswith("unused"):
                assert parameter.grad is None and (parameter == 1).all()


@pytest.mark.parametrize("root", ["mixed", 2, 4])
def test_the_root_and_its_scale_are_kept_in_files(root, make_model, tmp_path):
    model = make_model(policy_kwargs={"root": root})
    values = th.tensor([[-1.0], [0.0], [1e-6], [9.0], [300.0]]) + model.critic.floor
    model.policy.save(tmp_path / "policy.zip")
    model.save(tmp_path / "model")
    for critic in (LyapunovPolicy.load(tmp_path / "policy.zip").critic, LAC.load(tmp_path / "model").critic):
        assert critic.degree == model.critic.degree and th.equal(critic.root(values), model.critic.root(values))
        th.testing.assert_close(critic.value(critic.root(values)), values)
        distances = [-1.0, 0.0, 1e-3, 3.0, 300**0.5]
        assert critic.distance(critic.root(values)).flatten().tolist() == pytest.approx(distances, rel=2e-2, abs=1e-6)


def test_the_default_root_is_a_fourth_near_the_floor_and_a_square_one_far_above_and_knows_no_unit(make_model):
    critic = make_model(n_collect=0).critic
    costs = th.linspace(0.0, 10.0, 256)[:, None]
    critic.follow(costs, 0.005)
    near, far = (th.tensor([[1.0], [16.0]]) * size for size in (1e-12, 1e12))
    for values, power in ((near, 2.0), (far, 4.0)):
        low, high = critic.root(values).flatten().tolist()
        assert high / low == pytest.approx(power, rel=1e-2)
    roots = critic.root(costs)
    other = make_model(n_collect=0).critic
    other.follow(100 * costs, 0.005)
    th.testing.assert_close(other.root(100 * costs), 10 * roots)


def test_one_that_is_no_root_is_refused_and_roots_are_of_lac_alone(make_model):
    with pytest.raises(ValueError, match=r"root=3 must be 'mixed', 2 .* or 4"):
        make_model(policy_kwargs={"root": 3})
    with pytest.raises(TypeError, match="root"):
        make_model(algorithm=PublishedLAC, policy_kwargs={"root": 2})
    model = make_model(n_collect=0)
    alone = MlpPolicy(model.observation_space, model.action_space, lambda _: 1e-3)
    assert alone.critic.degree is model.critic.degree is None


@pytest.mark.parametrize(("stated", "root"), [({}, 4), ({"root": None}, 4), ({"root": 2}, 2), ({"root": 4}, 4)])
def test_weights_that_go_with_no_root_are_of_the_fourth_unless_one_was_stated(stated, root, make_model):
    model = make_model(n_collect=0, policy_kwargs=stated)
    weights = {name: value for name, value in model.policy.state_dict().items() if not name.endswith("root_degree")}
    model.policy.load_state_dict(weights)
    assert model.critic.degree == model.critic_target.degree == root
    other = make_model(n_collect=0)
    other.policy.load_state_dict(model.policy.state_dict())
    assert other.critic.degree == root


def test_any_numbers_load_as_weights_as_into_policies_of_sb3(make_model):
    policy = make_model(n_collect=0).policy
    drawn = {name: th.rand_like(value) for name, value in policy.state_dict().items()}
    policy.load_state_dict(drawn)
    assert all(th.equal(value, drawn[name]) for name, value in policy.state_dict().items())


def test_weights_of_0_7_0_keep_their_root(make_model):
    weights = make_model(n_collect=0, policy_kwargs={"root": 2}).policy.state_dict()
    for critic in ("critic", "critic_target"):
        weights[f"{critic}._extra_state"] = th.tensor(int(weights.pop(f"{critic}.root_degree")))
    policy = make_model(n_collect=0).policy
    policy.load_state_dict(weights)
    assert policy.critic.degree == policy.critic_target.degree == 2

"""The cost environments: their equations written out a second time, limits of parameters, and Gymnasium's contract."""

import copy
import pickle
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from stable_baselines3.common.env_checker import check_env

from sb3_lac.envs import (
    CartPoleCostEnv,
    DomainRandomization,
    LinearCostEnv,
    OscillatorEnv,
    PendulumCostEnv,
    QuadrotorCostEnv,
    VehicleCostEnv,
    reference_controller,
)
from sb3_lac.envs.base import CostEnv

IDS = ["CartPoleCost-v0", "LinearCost-v0", "Oscillator-v0", "PendulumCost-v0", "QuadrotorCost-v0", "VehicleCost-v0"]
CLASSES = [CartPoleCostEnv, LinearCostEnv, OscillatorEnv, PendulumCostEnv, QuadrotorCostEnv, VehicleCostEnv]
GAMMA = 0.95


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", IDS)
def test_both_checkers_find_nothing(env_id):
    check_env(gym.make(env_id, render_mode="rgb_array"))
    check_gymnasium_env(gym.make(env_id, render_mode="rgb_array").unwrapped)


class Undrawn(OscillatorEnv):
    """A plant of which there is no drawing."""

    _draw = CostEnv._draw


@pytest.mark.parametrize("make", [*CLASSES, Undrawn])
def test_a_picture_shows_the_plant_where_it_is_and_the_state_in_numbers_without_a_drawing(make):
    env, plants = make(render_mode="rgb_array"), []
    for start in (0.0, 0.3):
        env.reset(seed=0, options={"state": np.full(len(env.state_names), start)})
        plants.append(env.render()[:, :400])
    assert not np.array_equal(*plants) and plants[0].shape == (300, 400, 3)


@pytest.mark.parametrize("env_id", IDS)
def test_episodes_are_as_long_as_their_pages_say(env_id):
    page = Path(__file__).parents[2] / f"docs/environments/{env_id}.md"
    assert f"Truncation: {gym.spec(env_id).max_episode_steps} steps" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("make", CLASSES)
def test_same_seed_same_episode_after_pickling_and_copying(make):
    env = make()
    env.reset(seed=3)
    env.action_space.seed(3)
    actions = [env.action_space.sample() for _ in range(20)]
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    expected = [env.step(action)[0] for action in actions]
    for twin in twins:
        np.testing.assert_array_equal([twin.step(action)[0] for action in actions], expected)


@pytest.mark.parametrize("make", CLASSES)
@settings(max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), scale=st.floats(0.0, 100.0))
def test_observations_stay_in_their_space_whatever_the_actions(make, seed, scale):
    env = make()
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(30):
        observation, reward, terminated, _, info = env.step(scale * rng.standard_normal(env.action_space.shape))
        assert env.observation_space.contains(observation)
        assert -np.inf < reward == -info["cost"] <= 0
        if terminated:
            break


def after_one_step(env, state, action):
    """The state to which a step leads."""
    env.reset(options={"state": state})
    env.step(np.asarray(action, dtype=np.float64))
    return env.state


def test_cart_pole_accelerations_solve_the_equations_of_motion():
    # Lagrange's equations of cart and pole (a rod about its end), solved here as a linear system
    state, force = np.array([0.3, -0.4, 0.2, 0.7]), 6.0
    env = CartPoleCostEnv(cart_mass_kg=1.3, pole_mass_kg=0.2, pole_half_length_m=0.7)
    m, mass, half, sine, cosine = 0.2, 1.5, 0.7, np.sin(0.2), np.cos(0.2)
    left = np.array([[mass, m * half * cosine], [cosine, 4.0 / 3.0 * half]])
    right = np.array([force + m * half * 0.7**2 * sine, 10.0 * sine])
    accelerations = np.linalg.solve(left, right)
    expected = state + 0.02 * np.array([-0.4, accelerations[0], 0.7, accelerations[1]])
    np.testing.assert_allclose(after_one_step(env, state, [force / 20.0]), expected, rtol=1e-6)


def test_oscillator_follows_its_equations():
    env = OscillatorEnv()
    env.reset(options={"state": np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])})
    observation, _, _, _, info = env.step(np.array([-1.0, 0.0, 1.0]))
    # Each messenger is repressed by the protein before it: 3, 1, 2
    messengers = [m + 1.6 / (1 + p**2) - 0.16 * m + 5.0 * u for m, p, u in ((1, 6, 0.0), (2, 4, 0.5), (3, 5, 1.0))]
    proteins = [p + 0.16 * m - 0.06 * p for m, p in ((1, 4), (2, 5), (3, 6))]
    references = [8 + 7 * np.sin(2 * np.pi * t / 200) for t in (1, 2)]
    np.testing.assert_allclose(observation, [*messengers, *proteins, *references], rtol=1e-6)
    assert info["cost"] == pytest.approx((proteins[0] - references[0]) ** 2)
    assert info["error"] == pytest.approx(abs(proteins[0] - references[0]))


def test_pendulum_follows_newtons_law():
    env = PendulumCostEnv(mass_kg=0.7, length_m=1.3, damping_Nms=0.4)

    def law(_, x):
        # Torques of gravity, friction and motor about the pivot
        return [x[1], (0.7 * 9.81 * 1.3 * np.sin(x[0]) - 0.4 * x[1] + 3.0 * 0.6) / (0.7 * 1.3**2)]

    expected = solve_ivp(law, (0.0, 0.05), [2.0, -3.0], rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(after_one_step(env, [2.0, -3.0], [0.6]), expected, rtol=1e-6)


def test_pendulum_goes_round_and_its_speed_ends_at_that_of_the_motor():
    env = PendulumCostEnv()
    state = after_one_step(env, [3.1, 4.0], [0.0])
    assert -np.pi <= state[0] < -2.9
    assert after_one_step(env, [-2.0, -11.99], [-1.0])[1] == -12.0


def test_quadrotor_follows_newtons_law():
    env = QuadrotorCostEnv(mass_kg=1.2, inertia_kg_m2=0.03, arm_m=0.3)
    left, right = 9.81 * 0.5 * (1 + 0.1), 9.81 * 0.5 * (1 + 0.15)

    def law(_, x):
        # Both forces act along the machine's axis, each at the end of an arm
        pull = (left + right) / 1.2 * np.array([-np.sin(x[2]), np.cos(x[2])])
        return [x[3], x[4], x[5], pull[0], pull[1] - 9.81, 0.3 * (right - left) / 0.03]

    start = [0.1, 0.2, 0.3, 0.4, -0.5, 0.6]
    expected = solve_ivp(law, (0.0, env.DT_S), start, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(after_one_step(env, start, [0.1, 0.15]), expected, rtol=1e-6)


def test_vehicle_is_where_it_would_be_on_a_map():
    # The same car in coordinates of the ground, and the path beside it
    env = VehicleCostEnv(mass_kg=1400.0, inertia_kg_m2=2300.0, friction=0.8)
    start, action = [0.8, 0.05, 0.3, -0.1, 0.01, 20.0], 0.2
    m, inertia, front, rear, speed = 1400.0, 2300.0, 1.3, 1.4, 15.0

    def tyre(load, slip):
        return 0.8 * load * np.sin(1.5 * np.arctan(10.0 * slip))

    def car(_, x):
        _, _, yaw, lateral, rate, steering = x
        loads = m * 9.81 * np.array([rear, front]) / (front + rear)
        on_front = tyre(loads[0], steering - np.arctan2(lateral + front * rate, speed))
        on_rear = tyre(loads[1], -np.arctan2(lateral - rear * rate, speed))
        return [
            speed * np.cos(yaw) - lateral * np.sin(yaw),
            speed * np.sin(yaw) + lateral * np.cos(yaw),
            rate,
            (on_front * np.cos(steering) + on_rear) / m - speed * rate,
            (front * on_front * np.cos(steering) - rear * on_rear) / inertia,
            (0.2 * action - steering) / 0.1,
        ]

    def path(s, y):
        return [np.cos(y[2]), np.sin(y[2]), env.curvature(s)]

    env.reset(options={"state": start})
    for _ in range(20):
        env.step(np.array([action]))
    # The path starts in the origin along the first axis
    end = solve_ivp(car, (0.0, 1.0), [0.0, start[0], start[1], *start[2:5]], rtol=1e-10, atol=1e-12).y[:, -1]
    foot = solve_ivp(path, (start[5], env.state[5]), [0.0, 0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
    along, across = np.array([np.cos(foot[2]), np.sin(foot[2])]), np.array([-np.sin(foot[2]), np.cos(foot[2])])
    difference = end[:2] - foot[:2]
    assert difference @ along == pytest.approx(0.0, abs=1e-3)
    assert env.state[0] == pytest.approx(difference @ across, abs=1e-3)
    assert abs(env.state[0] - 0.8) > 0.2
    np.testing.assert_allclose(env.state[1:5], [end[2] - foot[2], *end[3:]], atol=1e-3)


def test_the_observed_path_tells_the_place_on_it():
    env = VehicleCostEnv()
    for place in (10.0, 100.0, 149.0):
        observation, _ = env.reset(options={"state": [0.0] * 5 + [place]})
        expected = [15.0 * 0.015 * np.sin(2 * np.pi * s / 150) for s in (place, place + 15.0)]
        np.testing.assert_allclose(observation[5:], expected, rtol=1e-5)
    # The path goes on where it began
    assert 0.0 < after_one_step(env, [0.0] * 5 + [149.9], [0.0])[5] < 1.0


@pytest.mark.parametrize(
    ("make", "start", "action", "cost", "error"),
    [
        # The tip of a pole of 1 m
        (
            CartPoleCostEnv,
            [5.0, 0.0, 0.1, 0.0],
            [0.0],
            lambda x: (x[0] / 10) ** 2 + 20 * (x[2] / 0.349) ** 2,
            lambda x: np.hypot(x[0] + np.sin(x[2]), 1 - np.cos(x[2])),
        ),
        (PendulumCostEnv, [-1.0, 2.0], [-0.5], lambda x: x @ (x * [1.0, 0.1]) + 0.01 * 1.5**2, lambda x: abs(x[0])),
        (
            QuadrotorCostEnv,
            [0.5, -0.4, 0.3, 0.0, 0.0, 0.0],
            [-0.5, 0.2],
            lambda x: x[:3] @ (x[:3] * [0.16, 0.16, 0.07]) + 0.05 * (0.25 + 0.04),
            lambda x: np.hypot(x[0], x[1]),
        ),
        (
            VehicleCostEnv,
            [-0.5, 0.1, 0.3, 0.0, 0.04, 0.0],
            [-0.5],
            lambda x: 0.2 * x[0] ** 2 + 0.1 * (x[1] + np.arctan(x[2] / 15.0)) ** 2 + 0.1 * ((-0.5 - 0.2) / 2) ** 2,
            lambda x: abs(x[0]),
        ),
    ],
)
def test_cost_and_distance_to_the_goal_are_those_of_the_new_state(make, start, action, cost, error):
    env = make()
    env.reset(options={"state": start})
    *_, info = env.step(np.array(action))
    assert info == pytest.approx({"cost": cost(env.state), "error": error(env.state)})


@pytest.mark.parametrize(
    ("make", "state", "reward"),
    [
        (CartPoleCostEnv, [9.99, 5.0, 0.0, 0.0], -100.0),
        (CartPoleCostEnv, [0.0, 0.0, 0.34, 5.0], -100.0),
        (QuadrotorCostEnv, [1.49, 0, 0, 5, 0, 0], -300.0),
        (QuadrotorCostEnv, [0, 0, 1.56, 0, 0, 5], -300.0),
        (VehicleCostEnv, [1.99, 0.5, 0, 0, 0, 0], -300.0),
        (VehicleCostEnv, [0, 0.99, 0, 1, 0, 0], -300.0),
    ],
)
def test_leaving_is_a_termination_with_a_price(make, state, reward):
    env = make()
    env.reset(options={"state": state})
    assert env.step(np.zeros(env.action_space.shape))[1:3] == (reward, True)


@pytest.mark.parametrize("make", CLASSES)
class TestDisturbances:
    """They are the same for every problem."""

    @staticmethod
    def states(env, actions):
        """States of an episode from a fixed start in the middle of things."""
        rng = np.random.default_rng(1)
        env.reset(seed=0)
        env.reset(seed=0, options={"state": np.abs(env.state) * rng.uniform(0.1, 0.2, len(env.state))})
        return np.array([env.step(action) and env.state for action in actions])

    @pytest.fixture
    def actions(self, make):
        return np.random.default_rng(0).uniform(-0.3, 0.3, (12, *make().action_space.shape))

    @staticmethod
    def quiet(make, **disturbances):
        return make(**({"noise_std": 0.0} if make is LinearCostEnv else {}), **disturbances)

    def test_changed_parameters_change_the_plant_and_not_what_is_known_of_it(self, make, actions):
        known = self.quiet(make)
        usual = self.states(known, actions)
        for name, value in known.nominal_parameters.items():
            changed = 1.5 * value if value > 0 else 0.5
            surprised = self.quiet(make, changed_parameters={name: changed})
            assert surprised.nominal_parameters == known.nominal_parameters
            assert getattr(surprised, name) == changed and getattr(known, name) == value
            different = self.states(surprised, actions)
            assert not np.allclose(usual, different, rtol=1e-6, atol=1e-9), name
            # As if it had been made so
            np.testing.assert_array_equal(different, self.states(self.quiet(make, **{name: changed}), actions))

    def test_process_noise_has_its_size_on_each_variable(self, make, actions):
        usual = self.quiet(make)
        n = len(usual.state_high)
        # Far from any limit
        start = np.minimum(0.1 * usual.state_high, 0.1)
        sizes = 1e-4 * np.arange(n)
        env = self.quiet(make, process_noise=sizes)
        expected = after_one_step(usual, start, actions[0])
        noise = np.array([after_one_step(env, start, actions[0]) - expected for _ in range(400)])
        np.testing.assert_allclose(noise.std(axis=0), sizes, rtol=0.2, atol=1e-12)
        assert np.all(np.abs(noise.mean(axis=0)) <= 0.25 * sizes + 1e-12)

    def test_impulses_come_at_their_interval_in_both_directions(self, make, actions):
        signs = set()
        for seed in range(12):
            steps = []
            for env in (self.quiet(make), self.quiet(make, impulse=0.1, impulse_interval=3)):
                env.reset(seed=seed)
                steps.append(np.array([env.step(action) and env.state for action in actions[:3]]))
            difference = steps[1] - steps[0]
            assert not difference[:2].any() and difference[2].any()
            signs.add(float(np.sign(difference[2][np.flatnonzero(difference[2])[0]])))
        assert signs == {-1.0, 1.0}

    def test_observation_noise_is_on_what_is_seen_and_nowhere_else(self, make, actions):
        usual, noisy = self.quiet(make), self.quiet(make, observation_noise=0.05)
        usual.reset(seed=2), noisy.reset(seed=2)
        steps = [[env.step(action) for action in actions] for env in (usual, noisy)]
        assert [step[1:] for step in steps[0]] == [step[1:] for step in steps[1]]
        seen = [np.array([step[0] for step in taken]) for taken in steps]
        assert all(noisy.observation_space.contains(observation) for observation in seen[1])
        assert 0.02 < (seen[1] - seen[0]).std() < 0.08

    def test_delayed_actions_are_those_of_steps_before(self, make, actions):
        delayed = self.states(self.quiet(make, action_delay=3), actions)
        shifted = np.concatenate((np.zeros_like(actions[:3]), actions[:-3]))
        np.testing.assert_array_equal(delayed, self.states(self.quiet(make), shifted))

    def test_starts_do_not_depend_on_the_disturbances(self, make, actions):
        plain, disturbed = make(), make(impulse=1.0, process_noise=0.1, observation_noise=0.1, action_delay=2)
        plain.reset(seed=5), disturbed.reset(seed=5)
        np.testing.assert_array_equal(plain.state, disturbed.state)
        check_env(disturbed)

    def test_each_episode_samples_within_its_ranges_and_is_that_of_what_was_sampled(self, make, actions):
        name, value = next(iter(make().nominal_parameters.items()))
        ranges = {name: (0.9 * value, 1.1 * value), "action_delay": (0, 2), "impulse": (0.1, 0.2)}
        env, seen = self.quiet(make, drawn=ranges), []
        for seed in range(12):
            _, info = env.reset(seed=seed)
            drawn = info["drawn"]
            assert env.step(actions[0])[-1]["drawn"] == drawn and drawn.keys() == ranges.keys()
            assert all(low <= drawn[each] <= high for each, (low, high) in ranges.items())
            fixed = self.quiet(make, **{name: drawn.pop(name)}, **drawn)
            # the direction of a push is drawn, too
            fixed.impulse = env.impulse = 0.0
            env.reset(seed=seed), fixed.reset(seed=seed)
            env.impulse = 0.0
            for action in actions:
                assert env.step(action)[1:3] == fixed.step(action)[1:3]
            seen.append(drawn["action_delay"])
        assert set(seen) == {0, 1, 2} and all(type(delay) is int for delay in seen)
        assert env.nominal_parameters == make().nominal_parameters
        check_env(env)

    def test_drawn_noise_is_that_of_a_fixed_one(self, make, actions):
        sizes = []
        for seed in range(4):
            env = self.quiet(make, drawn={"observation_noise": (0.01, 0.5), "process_noise": (0.0, 1e-3)})
            _, info = env.reset(seed=seed)
            twin = self.quiet(make, **info["drawn"])
            twin.reset(seed=0)
            twin.np_random, twin.state = copy.deepcopy(env.np_random), env.state
            for action in actions:
                np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])
            sizes.append(info["drawn"]["observation_noise"])
        assert len(set(sizes)) == 4

    def test_last_actions_are_at_the_end_of_what_is_seen(self, make, actions):
        plain, env = self.quiet(make), self.quiet(make, last_actions=2)
        n, m = plain.observation_space.shape[0], env.action_space.shape[0]
        assert env.observation_space.shape == (n + 2 * m,)
        for _ in range(2):  # the second episode knows nothing of the first
            start, _ = plain.reset(seed=0)
            seen, _ = env.reset(seed=0)
            np.testing.assert_array_equal(seen, [*start, *np.zeros(2 * m)])
            before = np.zeros(m)
            for action in 4.0 * actions:
                expected, seen = plain.step(action)[0], env.step(action)[0]
                last = np.clip(action, -1.0, 1.0)
                np.testing.assert_array_equal(seen, np.float32([*expected, *last, *before]))
                assert env.observation_space.contains(seen)
                before = last
        controller = reference_controller(env)
        np.testing.assert_array_equal(controller.predict(seen)[0], reference_controller(plain).predict(expected)[0])


class TestDomainRandomization:
    """Attributes of any environment are drawn anew."""

    @settings(max_examples=25, deadline=None)
    @given(st.floats(0.1, 10.0), st.floats(0.0, 5.0), st.integers(1, 9), st.integers(0, 9), st.integers(0, 2**31))
    def test_attributes_lie_within_their_ranges_and_the_seed_decides(self, low, width, whole, more, seed):
        ranges = {"m": (low, low + width), "max_speed": (whole, whole + more)}
        env = DomainRandomization(gym.make("Pendulum-v1"), ranges)
        _, info = env.reset(seed=seed)
        drawn = info["drawn"]
        assert all(low <= drawn[name] <= high for name, (low, high) in ranges.items()) and type(drawn["max_speed"]) is int
        assert (env.unwrapped.m, env.unwrapped.max_speed) == (drawn["m"], drawn["max_speed"])
        assert env.step(env.action_space.sample())[-1]["drawn"] == drawn
        following = env.reset()[1]["drawn"]
        assert env.reset(seed=seed)[1]["drawn"] == drawn and env.reset()[1]["drawn"] == following

    def test_another_mass_moves_otherwise_and_starts_alike(self):
        starts, steps = [], []
        for env in (gym.make("Pendulum-v1"), DomainRandomization(gym.make("Pendulum-v1"), {"m": (2.0, 2.0)})):
            starts.append(env.reset(seed=1)[0])
            steps.append(env.step(np.ones(1, np.float32))[0])
        np.testing.assert_array_equal(*starts)
        assert (steps[0] != steps[1]).any()

    @pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*")
    def test_both_checkers_find_nothing_and_its_spec_makes_it_again(self):
        env = DomainRandomization(gym.make("Pendulum-v1"), {"l": (0.8, 1.2)})
        check_env(env)
        again = gym.make(env.spec)
        assert again.reset(seed=3)[1] == env.reset(seed=3)[1]
        check_gymnasium_env(env, skip_render_check=True)

    @pytest.mark.parametrize(
        ("drawn", "message"),
        [
            ({"mass": (1.0, 2.0)}, r"drawn has \['mass'\], which are none of \['dt', 'g', "),
            ({"action_space": (1.0, 2.0)}, "which are none of"),
            ({"spec.mass": (1.0, 2.0)}, r"\['spec.mass'\], which are none of"),
            ({"action_space.low[1]": (1.0, 2.0)}, "which are none of"),
            ({"last": (1.0, 2.0)}, r"last has 3 numbers\. Randomise one of them, as last\[0\], or give .* a property"),
            ({"m": (2.0, 1.0)}, r"drawn\['m'\]=\(2.0, 1.0\) must be the smallest and the largest value"),
            ({"m": (1.0, np.inf)}, "two finite numbers"),
            ({"m": 1.0}, "two finite numbers"),
            ({"m": (1.0, 2.0, 3.0)}, "two finite numbers"),
        ],
    )
    def test_bad_ranges_are_named(self, drawn, message):
        with pytest.raises(ValueError, match=message):
            env = gym.make("Pendulum-v1")
            env.unwrapped.last = np.zeros(3)
            DomainRandomization(env, drawn)

    def test_numbers_in_arrays_and_nested_objects_are_drawn_by_their_path_and_arrays_by_a_property(self):
        class Simulated(PendulumEnv):
            def __init__(self):
                super().__init__()
                self.model = SimpleNamespace(mass=np.array([0.0, 1.0, 2.0]), opt={"gravity": [0.0, 0.0, -9.81]})

            @property
            def factor(self):
                return self.model.mass[1]

            @factor.setter
            def factor(self, factor):
                self.model.mass[:] = factor * np.array([0.0, 1.0, 2.0])

        drawn = {"factor": (0.8, 1.2), "model.opt.gravity[2]": (-11.0, -9.0), "model.mass[0]": (3.0, 4.0)}
        env = DomainRandomization(Simulated(), drawn)
        for seed in range(3):
            values = env.reset(seed=seed)[1]["drawn"]
            model = env.unwrapped.model
            np.testing.assert_allclose(model.mass, [values["model.mass[0]"], values["factor"], 2 * values["factor"]])
            assert model.opt["gravity"] == [0.0, 0.0, values["model.opt.gravity[2]"]]


def linear_roll_outs(env, gain, n_episodes, n_steps):
    """States and costs of many roll-outs of the policy u = -K s, without the environment."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (n_episodes, 2))
    history, costs = [states], []
    for _ in range(n_steps):
        controls = -states @ gain.T
        costs.append(np.sum(states**2, axis=1) + np.sum(controls**2, axis=1))
        noise = env.noise_std * rng.standard_normal(states.shape)
        states = states @ env.A.T + controls @ env.B.T + noise
        history.append(states)
    return np.array(history), np.array(costs)


def test_linear_env_steps_and_costs_like_its_matrices():
    env = LinearCostEnv(noise_std=0.0)
    env.reset(options={"state": [0.5, -1.0]})
    observation, reward, *_ = env.step(np.array([0.5]))
    np.testing.assert_allclose(observation, [0.48 - 0.2, -0.1 - 0.96 + 0.5], rtol=1e-6)
    assert reward == pytest.approx(-(0.25 + 1.0 + 1.0))


def test_exact_value_is_the_mean_discounted_sum_of_costs():
    env = LinearCostEnv(noise_std=0.3)
    gain = np.array([[-0.1, 0.5]])
    states, costs = linear_roll_outs(env, gain, n_episodes=20_000, n_steps=300)
    sums = (GAMMA ** np.arange(300)[:, None] * costs).sum(axis=0)
    exact = env.cost_to_go(states[0], -states[0] @ gain.T, gain, GAMMA)
    for quarter in np.array_split(np.argsort(exact), 4):
        assert exact[quarter].mean() == pytest.approx(sums[quarter].mean(), rel=0.03)


@pytest.mark.parametrize(
    ("make", "kwargs", "message"),
    [
        (CartPoleCostEnv, {"cart_mass_kg": 0.0}, "cart_mass_kg=0.0 must be positive"),
        (OscillatorEnv, {"process_noise": -1.0}, "process_noise=-1.0 must be a number, or 6 of them, finite and at least 0"),
        (PendulumCostEnv, {"damping_Nms": -0.1}, "damping_Nms=-0.1 must be finite and at least 0"),
        (PendulumCostEnv, {"changed_parameters": {"length": 2.0}}, r"has \['length'\], which are none of \['damping_Nms', "),
        (
            VehicleCostEnv,
            {"drawn": {"frictions": (0.5, 1.0)}},
            r"drawn has \['frictions'\], which are none of \['action_delay', ",
        ),
        (VehicleCostEnv, {"drawn": {"friction": (0.0, 1.0)}}, "friction=0.0 must be positive"),
        (VehicleCostEnv, {"drawn": {"action_delay": (0, 1.5)}}, "action_delay=1.5 must be a whole number"),
        (VehicleCostEnv, {"drawn": {"process_noise": (-1.0, 1.0)}}, "process_noise=-1.0 must be a number"),
        (VehicleCostEnv, {"last_actions": -1}, "last_actions=-1 must be finite and at least 0"),
        (QuadrotorCostEnv, {"action_delay": 0.5}, "action_delay=0.5 must be a whole number"),
        (VehicleCostEnv, {"steering_max_rad": 1.5}, "steering_max_rad=1.5 must be at most 1"),
        (LinearCostEnv, {"noise_std": np.nan}, "noise_std=nan must be finite and at least 0"),
        (LinearCostEnv, {"render_mode": "human"}, "render_mode='human' must be one of"),
    ],
)
def test_bad_arguments_are_named(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: env.reset(options={"state": [1.0]}), "must hold 2 numbers"),
        (lambda env: env.reset(options={"start": [1.0, 0.0]}), r"options \['start'\] are unknown"),
        (lambda env: env.step(np.array([1j])), "must be real numbers"),
        (lambda env: env.step(["0.5"]), "must be real numbers"),
        (lambda env: env.reset(options={"state": [np.nan, 0.0]}), "must hold 2 numbers"),
        (lambda env: env.reset(options={"state": [2000.0, 0.0]}), "must hold 2 numbers"),
        (lambda env: env.step(np.array([np.nan])), "must be finite numbers"),
        (lambda env: env.step(np.zeros(2)), "must be finite numbers"),
        (lambda env: env.value_matrix(np.array([[-5.0, -5.0]]), GAMMA), "spectral radius"),
    ],
)
def test_bad_states_actions_and_gains_are_named(call, message):
    env = LinearCostEnv()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        call(env)

"""Slow noise of which a fit has followed a part: its restricted likelihood against dense matrices, its intervals."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter

from servolens import fit, identify, lab
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.restricted import Part, estimated, mean_spectrum, with_followed

SLOW_SENSOR = lab.Setup(
    surroundings=lab.Surroundings(noise=lab.SensorNoise(deviation=1e-5, autoregression=(0.99,))),
)


def covariance_of(pole, ratio, n):
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    return pole**lags / (1.0 - pole**2) + ratio * np.eye(n)


def dense_misfit(pole, ratio, part):
    """Return −2 restricted log-likelihood from the covariance itself, its size the likeliest (Harville 1977)."""
    n, p = part.sensitivity.shape
    inverse = np.linalg.inv(covariance_of(pole, ratio, n))
    information = part.sensitivity.T @ inverse @ part.sensitivity
    projected = inverse - inverse @ part.sensitivity @ np.linalg.solve(information, part.sensitivity.T @ inverse)
    left = part.left @ projected @ part.left
    return (n - p) * np.log(left / (n - p)) - np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(information)[1]


def slow_part(seed, n=300, pole=0.98, white=1.0):
    stream = np.random.default_rng(seed)
    factor = np.linalg.cholesky(covariance_of(pole, white, n))
    t = np.linspace(-1.0, 1.0, n)
    columns = np.column_stack([np.ones(n), t, t**2, t**3])
    noise = factor @ stream.standard_normal(n)
    return Part(noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0], columns)


def test_restricted_likelihood_is_that_of_the_covariance():
    part = slow_part(0)
    pole, ratio = 0.95, 3.0
    factor = np.linalg.cholesky(covariance_of(pole, ratio, part.left.size))
    white = Part(np.linalg.solve(factor, part.left), np.linalg.solve(factor, part.sensitivity))
    found = estimated([white], 2.0 * float(np.sum(np.log(np.diag(factor))))).misfit
    assert found == pytest.approx(dense_misfit(pole, ratio, part), abs=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_likeliest_slow_noise_is_the_best_of_the_dense_likelihood(seed):
    part = slow_part(seed, n=120)
    _, found = mean_spectrum([part], 65)
    best = min(
        minimize(
            lambda x: dense_misfit(np.exp(-np.exp(-x[0])), np.exp(x[1]), part),
            start,
            method="Nelder-Mead",
            bounds=[(0.0, np.log(2000.0)), (np.log(1e-2), np.log(1e4))],
        ).fun
        for start in ([3.0, 0.0], [5.0, 1.0])
    )
    assert best - 1e-6 <= found <= best + 0.5  # time constants are compared on a grid


def test_parts_of_several_records_count_together():
    one, other = slow_part(1), slow_part(2)
    nothing = np.zeros_like(one.sensitivity)
    apart = [
        Part(one.left, np.hstack([one.sensitivity, nothing])),
        Part(other.left, np.hstack([nothing, other.sensitivity])),
    ]
    both = Part(
        np.concatenate([one.left, other.left]),
        np.vstack([part.sensitivity for part in apart]),
    )
    factor = np.linalg.cholesky(covariance_of(0.9, 2.0, one.left.size))
    white = [Part(np.linalg.solve(factor, p.left), np.linalg.solve(factor, p.sensitivity)) for p in apart]
    determinant = 4.0 * float(np.sum(np.log(np.diag(factor))))
    whole = np.kron(np.eye(2), factor)
    joined = Part(np.linalg.solve(whole, both.left), np.linalg.solve(whole, both.sensitivity))
    assert estimated(white, determinant).misfit == pytest.approx(estimated([joined], determinant).misfit, abs=1e-8)
    assert mean_spectrum(apart, 65)[1] < estimated(white, determinant).misfit


def test_estimate_is_that_of_generalised_least_squares():
    part = slow_part(7, 200)
    covariance = covariance_of(0.95, 0.5, 200)
    factor = np.linalg.cholesky(covariance)
    unseen = np.column_stack([part.sensitivity, np.zeros(200)])
    white = Part(np.linalg.solve(factor, part.left), np.linalg.solve(factor, unseen))
    found = estimated([white], 0.0)
    inverse = np.linalg.inv(covariance)
    information = part.sensitivity.T @ inverse @ part.sensitivity
    change = -np.linalg.solve(information, part.sensitivity.T @ inverse @ part.left)
    left = part.left + part.sensitivity @ change
    size = left @ inverse @ left / (200 - part.sensitivity.shape[1])
    assert found.change == pytest.approx([*change, 0.0], rel=1e-6, abs=1e-9)
    assert found.variances == pytest.approx([*(size * np.diag(np.linalg.inv(information))), 0.0], rel=1e-6)


def test_variance_of_estimates_is_not_understated_on_average():
    frequencies, n = 4097, 300
    truth = covariance_of(0.98, 1.0, n)
    ratios, naive = [], []
    for seed in range(30):
        part = slow_part(100 + seed, n)
        weights = np.linalg.pinv(part.sensitivity)[3]  # with which noise enters the estimate of the cubic term
        spectrum, _ = mean_spectrum([part], frequencies)
        lags = np.fft.irfft(spectrum)[:n]
        modelled = lags[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
        ratios.append(weights @ modelled @ weights / (weights @ truth @ weights))
        shown = np.correlate(part.left, part.left, "full")[n - 1 :] / n
        naive.append(
            weights
            @ shown[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
            @ weights
            / (weights @ truth @ weights)
        )
    assert 0.8 < np.median(ratios) < 2.0
    assert np.median(naive) < 0.5  # what the residual shows by itself


def test_a_filter_of_what_a_fit_has_left_counts_what_it_has_followed():
    """Beside that filter alone variances are two fifths too small; noise of two poles without a white part."""
    n, poles = 1500, (0.97, 0.4)
    t = np.linspace(-1.0, 1.0, n)
    columns = np.column_stack([t**k for k in range(6)])
    weights = np.linalg.pinv(columns)[3]
    filters = np.convolve(*([1.0, -pole] for pole in poles))

    def variance(spectrum):
        lags = np.fft.irfft(spectrum)[:n]
        return weights @ lags[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))] @ weights

    def spectrum_of(noise):
        return noise.innovation**2 / np.abs(np.fft.rfft(noise.filters[-1], 8192)) ** 2

    truth = variance(1.0 / np.abs(np.fft.rfft(filters, 8192)) ** 2)
    naive, counted = [], []
    for seed in range(40):
        noise = lfilter([1.0], filters, np.random.default_rng(seed).standard_normal(n + 400))[400:]
        part = Part(noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0], columns)
        whitener = Whitener(np.zeros(n), np.zeros(n), NoiseModel.white(1.0))
        plain = NoiseModel.white(1.0).coloured([part.left], [whitener], for_errors=True)
        found = with_followed(plain, [part], [whitener.beside(plain)])
        assert found.counts_followed
        naive.append(variance(spectrum_of(plain)) / truth)
        counted.append(variance(spectrum_of(found)) / truth)
    assert np.mean(naive) < 0.75
    assert 0.85 < np.mean(counted) < 1.15


@pytest.mark.slow
def test_intervals_of_the_velocity_law_hold_in_slow_noise():
    deviations = []
    for seed in range(720_000, 720_012):
        record = lab.step_record(lab.NLM3, 100.0, seed=seed, setup=SLOW_SENSOR)
        quantities = identify(record, model="velocity").velocity.quantities
        truth = {"gain": lab.NLM3.gain, "damping": lab.NLM3.damping}
        law = lab.NLM3.effects["velocity_decay_damping"]
        truth |= {f"velocity_decay_damping.{name}": value for name, value in law.items()}
        deviations += [(quantities[name].value - value) / quantities[name].stderr for name, value in truth.items()]
    assert np.sqrt(np.mean(np.square(deviations))) < 1.35  # 1.6 where the fit is taken to have followed no noise
    assert np.mean(np.abs(deviations) < 1.96) > 0.85


def test_slow_noise_is_not_said_to_be_unexplained_by_the_model():
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 0.2}})
    for seed in range(720_100, 720_103):
        records = [lab.step_record(axis, kp, seed=seed + kp, setup=SLOW_SENSOR) for kp in (40, 100)]
        found = fit("constant_force", records)
        assert "above_noise" not in {finding.code for finding in found.findings}
        assert found.at_noise
    wrong = fit("constant_force", [lab.step_record(lab.NLM3, 100.0, seed=720_200, setup=SLOW_SENSOR)])
    assert "above_noise" in {finding.code for finding in wrong.findings}


@pytest.mark.parametrize(
    ("effect", "sizes"),
    [
        ("backlash", {"gap": 3e-4, "load_share": 0.3}),
        ("flexible_coupling", {"frequency": 60.0, "damping_ratio": 0.02, "load_ratio": 0.5}),
    ],
)
def test_what_rings_is_no_slow_noise(effect, sizes):
    axis = lab.Truth(gain=1.9, damping=6.0, effects={effect: sizes})
    found = fit((), [lab.step_record(axis, kp, seed=720_300 + kp) for kp in (40, 100)])
    assert "above_noise" in {finding.code for finding in found.findings}


def test_fit_driven_by_the_voltage_keeps_the_colour_of_slow_noise():
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 0.2}})
    truth = {"gain": 1.9, "damping": 6.0, "constant_force.acceleration": 0.2}
    deviations = []
    for seed in range(720_400, 720_406):
        records = [lab.step_record(axis, kp, seed=seed + 1000 * kp, setup=SLOW_SENSOR) for kp in (40, 100)]
        quantities = fit("constant_force", records, driven="voltage").quantities
        deviations += [(quantities[name].value - value) / quantities[name].stderr for name, value in truth.items()]
    assert np.sqrt(np.mean(np.square(deviations))) < 2.0  # 30 beside white noise


def test_filter_that_suits_the_noise_better_than_slow_noise_is_kept():
    quick = lab.SensorNoise(deviation=1e-5, autoregression=(-0.7,))
    setup = lab.Setup(surroundings=lab.Surroundings(noise=quick, encoder=1e-7))
    axis = lab.Truth(gain=1.9, damping=6.0)
    noise = fit((), [lab.step_record(axis, kp, seed=720_500 + kp, setup=setup) for kp in (40, 100)]).noise_model
    assert noise.innovation == pytest.approx(1e-5 * np.sqrt(1.0 - 0.7**2), rel=0.1)

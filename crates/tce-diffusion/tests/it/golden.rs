//! Every process with every sampler, fed with the exact denoiser of a Gaussian and of a mixture of two.

use tce_base::random::fill_normal;
use tce_base::{Rng, Streams};
use tce_diffusion::{Denoiser, Edm, Grid, Guided, Level, Process, Sampler, Start, Ve, Vp};
use tce_nn::burn::tensor::activation::sigmoid;
use tce_nn::{Tensor, cpu, host, tensor};

const ROWS: usize = 20_000;

/// N(mean, diag std²).
struct Gaussian {
    mean: [f32; 3],
    std: [f32; 3],
}

const GAUSSIAN: Gaussian = Gaussian { mean: [0.5, -0.3, 0.0], std: [1.0, 0.5, 0.2] };

/// `LEFT` N(−1.2, .2²) + (1 − `LEFT`) N(.8, .2²): mean 0, variance 1.
struct Mixture;
const LEFT: f64 = 0.4;
const MODES: [f64; 2] = [-1.2, 0.8];
const MODE_STD: f64 = 0.2;

impl Denoiser for Gaussian {
    fn denoise(&self, x: Tensor<3>, Level { alpha, sigma, .. }: Level) -> Tensor<3> {
        let row = |v: [f32; 3]| tensor(v.to_vec(), [1, 1, 3], &cpu());
        let gain = self.std.map(|s| (alpha * (s * s) as f64 / (alpha * alpha * (s * s) as f64 + sigma * sigma)) as f32);
        row(self.mean) + (x - row(self.mean) * alpha) * row(gain)
    }
}

impl Denoiser for Mixture {
    fn denoise(&self, x: Tensor<3>, Level { alpha, sigma, .. }: Level) -> Tensor<3> {
        let variance = (alpha * MODE_STD).powi(2) + sigma * sigma;
        let square = |m: f64| (x.clone() - m * alpha).square() / (2.0 * variance);
        let right = sigmoid(square(MODES[0]) - square(MODES[1]) + ((1.0 - LEFT) / LEFT).ln());
        let gain = alpha * MODE_STD * MODE_STD / variance;
        let mode = |m: f64| (x.clone() - m * alpha) * gain + m;
        mode(MODES[1]) * right.clone() + mode(MODES[0]) * (-right + 1.0)
    }
}

fn normal(rng: &mut Rng, d: usize) -> Tensor<3> {
    let mut z = vec![0.0; ROWS * d];
    fill_normal(rng, &mut z);
    tensor(z, [1, ROWS, d], &cpu())
}

/// Samples, column by column. `data` gives rows of the data itself, for processes that start there.
fn sample(
    process: &Process,
    sampler: Sampler,
    denoiser: &impl Denoiser,
    d: usize,
    data: impl Fn(Tensor<3>) -> Tensor<3>,
) -> Vec<Vec<f64>> {
    let mut rng = Streams::new(11).stream("golden");
    let mut start = normal(&mut rng, d) * process.start_std();
    if process.starts_at_data() {
        start = start + data(normal(&mut rng, d));
    }
    let x = host(sampler.run(process, denoiser, start, &mut || normal(&mut rng, d)).unwrap());
    (0..d).map(|j| x.iter().skip(j).step_by(d).map(|v| *v as f64).collect()).collect()
}

fn moments(x: &[f64]) -> (f64, f64) {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    (mean, (x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

fn gaussian(process: &Process, sampler: Sampler) -> Vec<(f64, f64)> {
    let row = |v: [f32; 3]| tensor(v.to_vec(), [1, 1, 3], &cpu());
    let data = |z: Tensor<3>| z * row(GAUSSIAN.std) + row(GAUSSIAN.mean);
    sample(process, sampler, &GAUSSIAN, 3, data).iter().map(|c| moments(c)).collect()
}

/// (mass left of −.2, (mean, std) left of it, (mean, std) right of it)
fn mixture(process: &Process, sampler: Sampler) -> (f64, (f64, f64), (f64, f64)) {
    let data = |z: Tensor<3>| {
        // The quantile of a standard normal below which 40 % lie decides the mode; the sum has the modes' moments.
        let side: Vec<f32> = (0..ROWS).map(|i| MODES[usize::from(i % 5 >= 2)] as f32).collect();
        z * MODE_STD + tensor(side, [1, ROWS, 1], &cpu())
    };
    let x = sample(process, sampler, &Mixture, 1, data).remove(0);
    let (left, right): (Vec<f64>, Vec<f64>) = x.iter().partition(|x| **x < -0.2);
    (left.len() as f64 / ROWS as f64, moments(&left), moments(&right))
}

/// What exact solutions of the reverse SDE (`noisy`) or the probability-flow ODE make of the start, which for all
/// processes but VE from data is N(0, start²) instead of the marginal: both are linear for a Gaussian.
fn closed_form(process: &Process, noisy: bool, mean: f64, std: f64) -> (f64, f64) {
    if process.starts_at_data() {
        return (mean, std);
    }
    let end = if noisy { process.level(1.0) } else { process.ratio_grid(2, Grid::Log)[0] };
    let v = std * std;
    let ratio2 = (end.sigma / end.alpha).powi(2);
    let start2 = (process.start_std() / end.alpha).powi(2);
    let share = v / (v + ratio2);
    let (gain, added) = if noisy { (share, v * (1.0 - share)) } else { (share.sqrt(), 0.0) };
    (mean * (1.0 - gain), (gain * gain * start2 + added).sqrt())
}

fn ve(start: Start) -> Process {
    Process::Ve(Ve { start, ..Ve::default() })
}

fn vp() -> Process {
    Process::Vp(Vp::default())
}

fn edm() -> Process {
    Process::Edm(Edm::default())
}

const EULER: Sampler = Sampler::EulerMaruyama { steps: 500 };

/// (process, sampler, largest relative error of a standard deviation by discretisation).
fn deterministic() -> Vec<(Process, Sampler, f64)> {
    let (heun, dpm) = (Sampler::Heun { steps: 18 }, Sampler::DpmSolver { steps: 20 });
    vec![
        (ve(Start::Normal), heun, 0.03),
        (ve(Start::Normal), dpm, 0.03),
        (ve(Start::Data), heun, 0.03),
        (ve(Start::Data), dpm, 0.03),
        (vp(), heun, 0.06),
        (vp(), dpm, 0.03),
        (edm(), heun, 0.06),
        (edm(), dpm, 0.025),
    ]
}

/// Against the closed forms: within the discretisation error and three standard errors of 20 000 rows.
#[test]
fn a_gaussian_ends_where_the_equations_take_it() {
    let stochastic = [ve(Start::Normal), ve(Start::Data), vp(), edm()].map(|p| (p, EULER, 0.02));
    for (process, sampler, tolerance) in deterministic().into_iter().chain(stochastic) {
        for (d, (mean, std)) in gaussian(&process, sampler).into_iter().enumerate() {
            let (true_mean, true_std) = (GAUSSIAN.mean[d] as f64, GAUSSIAN.std[d] as f64);
            let (m, s) = closed_form(&process, sampler == EULER, true_mean, true_std);
            let context = format!("{process:?} {sampler:?} {d}: {mean} {std}, expected {m} {s}");
            assert!((mean - m).abs() < 0.022 * true_std, "{context}");
            assert!((std / s - 1.0).abs() < tolerance + 0.015, "{context}");
        }
    }
}

/// The Langevin corrector brings even VE as written, whose start loses a quarter of the variance, to the data; its own
/// bias at SNR .16 is some percent of a standard deviation.
#[test]
fn predictor_corrector_reaches_the_data() {
    for process in [ve(Start::Normal), vp(), edm()] {
        for (d, (mean, std)) in gaussian(&process, Sampler::paper()).into_iter().enumerate() {
            let (m, s) = (GAUSSIAN.mean[d] as f64, GAUSSIAN.std[d] as f64);
            assert!((mean - m).abs() < 0.03 * s, "{process:?} {d}: mean {mean}");
            assert!((std / s - 1.0).abs() < 0.05, "{process:?} {d}: std {std}");
        }
    }
}

#[test]
fn two_modes_get_their_shares_and_widths() {
    let paper = [ve(Start::Normal), vp(), edm()].map(|p| (p, Sampler::paper()));
    let euler = [ve(Start::Data), vp(), edm()].map(|p| (p, EULER));
    // The start of VE as written misses the variance, which without a corrector nothing mends.
    let fine = [ve(Start::Data), vp(), edm()].map(|p| {
        [Sampler::Heun { steps: 60 }, Sampler::DpmSolver { steps: 60 }, Sampler::SdeDpmSolver { steps: 100 }]
            .map(|s| (p, s))
    });
    for (process, sampler) in paper.into_iter().chain(euler).chain(fine.into_iter().flatten()) {
        let (share, left, right) = mixture(&process, sampler);
        let context = format!("{process:?} {sampler:?}: {share:.3} {left:.3?} {right:.3?}");
        // Three standard errors of the share are .0104, of a width 1.7 % of it; the rest is discretisation.
        assert!((share - LEFT).abs() < 0.012, "{context}");
        for ((mean, std), mode) in [left, right].into_iter().zip(MODES) {
            assert!((mean - mode).abs() < 0.01, "{context}");
            assert!((std / MODE_STD - 1.0).abs() < 0.04, "{context}");
        }
    }
}

/// At the default number of steps the modes of VP and EDM come out up to a tenth wider; the error is of second order.
#[test]
fn four_times_the_steps_shrink_the_error_by_far() {
    for process in [vp(), edm()] {
        for with in [|steps| Sampler::Heun { steps }, |steps| Sampler::DpmSolver { steps }] {
            let error = |steps| (mixture(&process, with(steps)).1.1 / MODE_STD - 1.0).abs();
            let (coarse, fine) = (error(20), error(80));
            assert!(coarse < 0.12 && fine < coarse / 2.0 && fine < 0.025, "{process:?}: {coarse} {fine}");
        }
    }
}

/// Two Gaussians of one width: (1 − w) and w parts of their linear denoisers are the denoiser of a Gaussian of that width around
/// m₀ + w (m₁ − m₀), so that guidance has a closed form at every level and at the end of every sampler.
#[test]
fn guidance_moves_a_gaussian_as_far_as_its_weight_says() {
    let without = || Gaussian { mean: [-0.4, 0.0, 0.3], ..GAUSSIAN };
    let mean = |w: f64| [0, 1, 2].map(|d| (1.0 - w) as f32 * without().mean[d] + w as f32 * GAUSSIAN.mean[d]);
    for w in [0.0, 1.0, 1.2, 3.0] {
        let guided = Guided { with: GAUSSIAN, without: without(), weight: w };
        let exact = Gaussian { mean: mean(w), ..GAUSSIAN };
        for process in [vp(), edm()] {
            for tau in [0.1, 0.5, 1.0] {
                let x = normal(&mut Streams::new(2).stream("x"), 3);
                let (a, b) = (guided.denoise(x.clone(), process.level(tau)), exact.denoise(x, process.level(tau)));
                assert!(host(a).iter().zip(host(b)).all(|(a, b)| (a - b).abs() < 1e-5), "{w} {process:?} {tau}");
            }
        }
        let columns = sample(&edm(), Sampler::SdeDpmSolver { steps: 40 }, &guided, 3, |z| z);
        for (d, column) in columns.iter().enumerate() {
            let ((m, s), std) = (moments(column), GAUSSIAN.std[d] as f64);
            assert!((m - mean(w)[d] as f64).abs() < 0.03 * std, "{w} {d}: {m}");
            assert!((s / std - 1.0).abs() < 0.04, "{w} {d}: {s}");
        }
    }
}

/// A condition that says which mode: more than weight 1 does not leave the mode, and weight 0 gives both.
#[test]
fn guidance_of_a_mixture_keeps_to_the_mode() {
    struct Mode;
    impl Denoiser for Mode {
        fn denoise(&self, x: Tensor<3>, Level { alpha, sigma, .. }: Level) -> Tensor<3> {
            let gain = alpha * MODE_STD * MODE_STD / ((alpha * MODE_STD).powi(2) + sigma * sigma);
            (x - MODES[1] * alpha) * gain + MODES[1]
        }
    }
    let right = |weight| {
        let guided = Guided { with: Mode, without: Mixture, weight };
        let x = sample(&edm(), Sampler::DpmSolver { steps: 40 }, &guided, 1, |z| z).remove(0);
        x.iter().filter(|x| **x > -0.2).count() as f64 / ROWS as f64
    };
    assert!((right(0.0) - (1.0 - LEFT)).abs() < 0.012);
    assert!(right(1.0) > 0.999 && right(1.2) > 0.999);
}

//! What the generator gets right and wrong, measured against held-out target rows and the simulator.
//!
//! | metric | meaning |
//! |---|---|
//! | SW | sliced Wasserstein-1 distance of standardised states at ŷ = 0 to training and to held-out target states |
//! | std ratio | mean over dimensions of std(generated) / std(training) at ŷ = 0 |
//! | consistency | RMS over dimensions of (simulated(ŝ, â) − ŝ') / std(s' − s): the generated successor against what the target domain does with the inferred action |
//!
//! A consistency of 1 means errors as large as a whole step; real rows with inferred actions give the part that the
//! inverse dynamics model is to blame for.

use serde::Serialize;
use tce_augment::config::GeneratorConfig;
use tce_augment::finish::Finisher;
use tce_augment::two_stage::{Draw, Generator};
use tce_base::Streams;
use tce_data::{Agent, Rows, Shift, Standardizer, Support, Transitions};
use tce_diffusion::Sampler;
use tce_diffusion::metrics::{sliced_wasserstein, std_ratios};
use tce_learn::{LabelModels, TerminalHandling};
use tce_sim::simulate;

use crate::error::Result;

/// Random directions of a sliced Wasserstein distance.
const PROJECTIONS: usize = 256;

/// Median and 90th percentile over rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Consistency {
    /// Median.
    pub median: f64,
    /// 90th percentile.
    pub p90: f64,
}

/// One row of the generator's table.
#[derive(Clone, Debug, Serialize)]
pub struct Quality {
    /// Network evaluations per row and stage.
    pub evaluations: usize,
    /// SW to the training states.
    pub sw_training: f64,
    /// SW to held-out states.
    pub sw_held_out: f64,
    /// Mean std ratio.
    pub std_ratio: f64,
    /// Largest absolute standardised coordinate.
    pub largest: f64,
    /// At ŷ = 0, unfiltered.
    pub consistency: Consistency,
    /// At ŷ ~ U(0, y_max), filtered: what learners get.
    pub consistency_expanded: Consistency,
    /// Rows per second and stage.
    pub rows_per_second: f64,
}

/// Splits off the last episodes, at least `share` of the rows.
pub fn hold_out(data: &Transitions, share: f64) -> (Transitions, Transitions) {
    let wanted = ((1.0 - share) * data.len() as f64) as usize;
    let cut = data.episodes().iter().map(|e| e.start).filter(|&s| s <= wanted && s > 0).max().unwrap_or(wanted);
    (data.select(&(0..cut).collect::<Vec<_>>()), data.select(&(cut..data.len()).collect::<Vec<_>>()))
}

/// (simulated(s, a) − s') / std(s' − s), RMS over the live dimensions, for rows `[n, obs_dim]`.
pub fn consistency(
    agent: Agent,
    shift: Shift,
    rows: &Transitions,
    step_std: &[f32],
    live: &[usize],
) -> Result<Consistency> {
    let simulated = simulate(agent, shift, &rows.observations, &rows.actions)?.next_observations;
    let mut errors = step_errors(&simulated, rows, step_std, live);
    errors.sort_by(f64::total_cmp);
    let at = |q: f64| errors[((errors.len() - 1) as f64 * q) as usize];
    Ok(Consistency { median: at(0.5), p90: at(0.9) })
}

/// RMS over the live dimensions of (simulated − s') / std(s' − s), per row.
pub fn step_errors(simulated: &[f32], rows: &Transitions, step_std: &[f32], live: &[usize]) -> Vec<f64> {
    let error = |(simulated, generated): (&[f32], &[f32])| {
        let square = |(k, &i): (usize, &usize)| ((simulated[i] - generated[i]) as f64 / step_std[k] as f64).powi(2);
        let error = (live.iter().enumerate().map(square).sum::<f64>() / live.len() as f64).sqrt();
        // The physics may blow up in an impossible state; that is an error beyond measure, not one to leave out.
        if error.is_finite() { error } else { f64::INFINITY }
    };
    simulated.chunks_exact(rows.obs_dim).zip(rows.next_observations.chunks_exact(rows.obs_dim)).map(error).collect()
}

/// std(s' − s) of the live dimensions of `target`.
pub fn step_std(target: &Transitions, live: &[usize]) -> Vec<f32> {
    let steps: Vec<f32> = target
        .observations
        .chunks_exact(target.obs_dim)
        .zip(target.next_observations.chunks_exact(target.obs_dim))
        .flat_map(|(s, s2)| live.iter().map(|&i| s2[i] - s[i]))
        .collect();
    Standardizer::fit_on(&[Rows::new(&steps, live.len())]).std
}

/// A trained generator (member 0), and what it is measured by.
pub struct Tried<'a> {
    /// The networks.
    pub generator: &'a Generator,
    /// Inverse dynamics and reward.
    pub models: &'a LabelModels,
    /// The networks' settings.
    pub config: &'a GeneratorConfig,
    /// The filter of expanded rows.
    pub finisher: &'a Finisher<'a>,
    /// Rows that the networks were trained on.
    pub training: &'a Transitions,
    /// Rows that they were not.
    pub held_out: &'a Transitions,
    /// What expanded rows are made to respect.
    pub support: Option<&'a Support>,
    /// Where the truth is simulated.
    pub place: (Agent, Shift),
}

impl Tried<'_> {
    /// Measures one sampler on `rows` rows.
    ///
    /// # Errors
    /// If the sampler or the simulator fails.
    pub fn quality(&self, sampler: &Sampler, rows: usize, seed: u64) -> Result<Quality> {
        let Self { generator, models, config, finisher, training, held_out, support, place: (agent, shift) } = *self;
        let members = [Streams::new(seed)];
        let units = &generator.units;
        let d = units.live.len();
        let started = std::time::Instant::now();
        let draw = Draw::new(sampler, &members, training);
        let states = generator.sample_states(rows, 0.0, &draw)?;
        let seconds = started.elapsed().as_secs_f64();
        let successors = generator.sample_successors(&states, &draw)?;
        let scale = Standardizer::fit(&units.take(&training.observations), d);
        let generated = scale.apply(&states);
        let real = |t: &Transitions| scale.apply(&units.take(&t.observations));
        let (training_states, held_out_states) = (real(training), real(held_out));
        let sw = |other: &[f32]| sliced_wasserstein(&generated, other, d, PROJECTIONS, &members[0]);
        let ratios = std_ratios(&generated, &training_states, d);
        let finite: Vec<f64> = ratios.into_iter().filter(|r| r.is_finite()).collect();

        let step = step_std(training, &units.live);
        let pair = (units.put_back(&states), units.put_back(&successors));
        let at_zero = models.label(&[pair], TerminalHandling::None)?.remove(0).transitions;
        let (wider_states, wider_successors) = generator.sample_pairs(rows, config.y_max, &draw.within(support))?;
        let expanded = finisher.finish(&[(&wider_states, &wider_successors)])?.remove(0).transitions;
        Ok(Quality {
            evaluations: sampler.evaluations(),
            sw_training: sw(&training_states),
            sw_held_out: sw(&held_out_states),
            std_ratio: finite.iter().sum::<f64>() / finite.len() as f64,
            largest: generated.iter().fold(0.0f64, |m, &v| m.max(v.abs() as f64)),
            consistency: consistency(agent, shift, &at_zero, &step, &units.live)?,
            consistency_expanded: consistency(agent, shift, &expanded, &step, &units.live)?,
            rows_per_second: rows as f64 / seconds,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_episodes_are_held_out() {
        let mut t = Transitions::new(1, 1);
        (0..50).for_each(|i| t.push(&[i as f32], &[0.0], 0.0, &[0.0], false, i % 10 == 9));
        let (training, held_out) = hold_out(&t, 0.2);
        assert_eq!((training.len(), held_out.len()), (40, 10));
        assert_eq!(held_out.observations[0], 40.0);
    }

    #[test]
    fn the_spread_of_a_step_is_measured() {
        let mut t = Transitions::new(2, 1);
        for i in 0..100 {
            let step = if i % 2 == 0 { 0.1 } else { -0.1 };
            t.push(&[i as f32, 7.0], &[0.0], 0.0, &[i as f32 + step, 7.0], false, false);
        }
        assert!((step_std(&t, &[0])[0] - 0.1).abs() < 1e-3);
    }
}

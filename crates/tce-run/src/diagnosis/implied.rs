//! The policy that the generator implies, a = Inv(s, ŝ') with ŝ' ~ q_tran(· | s): its actions at real target states, and what it
//! gets when it is rolled out. What the metrics mean is told in [`tce_diagnosis::implied`].
//!
//! The inverse dynamics model has its own held-out rows, drawn one by one: most of those that q_tran has not seen it has. Its own error
//! at the same rows stands beside the metrics.

use rand::RngExt;
use tce_augment::two_stage::{Draw, Generator};
use tce_base::random::fill_normal;
use tce_base::{Rng, Streams, interrupted, mean_std};
use tce_data::Transitions;
use tce_diagnosis::{ImpliedActions, ImpliedErrors, ImpliedRollout};
use tce_diffusion::Sampler;
use tce_learn::LabelModels;
use tce_nn::{Device, host, tensor};
use tce_sim::{Actor, SimError};
use tce_zoo::actors::Arena;

use crate::error::{Error, Result};

/// Target rows of each group, at most.
const ROWS: usize = 2000;
/// Successors drawn at every row.
pub const DRAWS: usize = 8;

/// Acts by the inverse dynamics of a drawn successor.
///
/// A lane's noise comes from its own generator. Under the predictor-corrector sampler alone a lane's actions depend on the other lanes,
/// too: its step size is an average over the batch.
pub struct ImpliedActor<'a> {
    /// A population of one.
    generator: Generator,
    models: &'a LabelModels,
    /// The member of the label models.
    member: usize,
    sampler: Sampler,
    /// Standardised training outputs, for a process that starts at data.
    start: Option<Vec<f32>>,
    device: Device,
}

impl<'a> ImpliedActor<'a> {
    /// Of one member of a generator and of its label models. `target` are the rows that they were trained on.
    pub fn new(
        generator: &Generator,
        models: &'a LabelModels,
        member: usize,
        sampler: Sampler,
        target: &Transitions,
        device: &Device,
    ) -> Self {
        let generator = generator.member(member);
        let start = generator.transition.process().starts_at_data().then(|| generator.units.outputs(target));
        Self { generator, models, member, sampler, start, device: device.clone() }
    }

    /// One draw of ŝ' for each of the live states, in the data's units. Row i draws from `rngs[i]`.
    fn successors(&self, states: &[f32], rngs: &mut [Rng]) -> Result<Vec<f32>> {
        let Generator { units, transition, .. } = &self.generator;
        let (n, d) = (rngs.len(), units.live.len());
        let process = transition.process();
        let first = self.start.as_ref().map(|all| {
            let mut rows = Vec::with_capacity(n * d);
            for rng in rngs.iter_mut() {
                let i = rng.random_range(0..all.len() / d);
                rows.extend_from_slice(&all[i * d..(i + 1) * d]);
            }
            tensor(rows, [1, n, d], &self.device) * process.level(1.0).alpha
        });
        let mut normal = || {
            let mut z = vec![0.0; n * d];
            rngs.iter_mut().zip(z.chunks_exact_mut(d)).for_each(|(rng, row)| fill_normal(rng, row));
            tensor(z, [1, n, d], &self.device)
        };
        let noise = normal() * process.start_std();
        let x = match first {
            Some(first) => noise + first,
            None => noise,
        };
        let denoiser = transition.bind(tensor(units.state.apply(states), [1, n, d], &self.device));
        let mut out = host(self.sampler.run(&process, &denoiser, x, &mut normal)?);
        units.successors(states, &mut out);
        Ok(out)
    }

    fn actions(&self, observations: &[f32], rngs: &mut [Rng]) -> Result<Vec<f32>> {
        let units = &self.generator.units;
        let successors = units.put_back(&self.successors(&units.take(observations), rngs)?);
        Ok(self.models.actions(self.member, observations, &successors)?)
    }
}

impl Actor for ImpliedActor<'_> {
    type Memory = ();

    fn start(&self) {}

    fn act(&self, observations: &[f32], _: &mut [()], rngs: &mut [Rng], actions: &mut [f32]) {
        match self.actions(observations, rngs) {
            Ok(found) => actions.copy_from_slice(&found),
            // Ends the rollout: the simulator takes no such action.
            Err(_) => actions.fill(f32::NAN),
        }
    }
}

/// Implied actions at up to 2000 evenly spaced rows of `target` of each group: those that q_tran was trained on, and those that were
/// `held_out`, as indices. Draws come from the stream names of `streams` alone.
///
/// # Errors
/// If sampling fails, or the user interrupts.
pub fn implied_actions(
    actor: &ImpliedActor,
    target: &Transitions,
    (trained, held_out): (&[usize], &[usize]),
    draws: usize,
    streams: &Streams,
) -> Result<ImpliedActions> {
    let group = |rows: &[usize], name: &str| -> Result<Option<ImpliedErrors>> {
        if rows.is_empty() || draws == 0 {
            return Ok(None);
        }
        let count = rows.len().min(ROWS);
        let chosen: Vec<usize> = (0..count).map(|k| rows[k * rows.len() / count]).collect();
        let t = target.select(&chosen);
        let units = &actor.generator.units;
        let states = units.take(&t.observations).repeat(draws);
        let members = [streams.child(name)];
        let successors = actor.generator.sample_successors(&states, &Draw::new(&actor.sampler, &members, target))?;
        let repeated = t.observations.repeat(draws);
        let drawn = actor.models.actions(actor.member, &repeated, &units.put_back(&successors))?;
        let inferred = actor.models.actions(actor.member, &t.observations, &t.next_observations)?;
        let each: Vec<&[f32]> = drawn.chunks_exact(t.actions.len()).collect();
        Ok(ImpliedErrors::of(&each, &inferred, &t.actions, t.act_dim))
    };
    Ok(ImpliedActions { trained: group(trained, "trained")?, held_out: group(held_out, "held out")? })
}

/// Rolls the implied policy out. Everything random comes from `streams`; the same bytes at any number of threads.
///
/// # Errors
/// If the user interrupts, or the simulator cannot be used. Networks that give no numbers are told in the result.
pub fn rollout_implied(
    actor: &ImpliedActor,
    arena: Arena,
    episodes: usize,
    streams: Streams,
) -> Result<ImpliedRollout> {
    let results = match tce_sim::evaluate(arena.agent, arena.shift, actor, episodes, streams, interrupted) {
        Ok(results) => results,
        Err(SimError::NotFinite { .. }) if interrupted() => return Err(Error::interrupted()),
        Err(e @ SimError::NotFinite { .. }) => {
            let failed = Some(e.to_string());
            return Ok(ImpliedRollout { episodes, score: None, returns: None, length: None, failed });
        }
        Err(e) => return Err(e.into()),
    };
    let returns: Vec<f64> = results.iter().map(|r| r.episode_return).collect();
    let scores = |r: tce_data::ReferenceScores| returns.iter().map(|j| r.normalised_score(*j)).collect::<Vec<_>>();
    let length = results.iter().map(|r| r.length).sum::<usize>() as f64 / results.len().max(1) as f64;
    Ok(ImpliedRollout {
        episodes,
        score: arena.reference.map(|r| mean_std(&scores(r))),
        returns: Some(mean_std(&returns)),
        length: Some(length),
        failed: None,
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tce_base::random::fill_uniform;
    use tce_data::{Agent, Shift, Standardizer};
    use tce_diffusion::{
        Balance, Condition, Edm, NetworkConfig, Part, Process, Schedule, ScoreData, Target, TrainConfig, Trainer,
    };
    use tce_learn::{LabelConfig, Member, train_labels};
    use tce_nn::{Checkpoints, cpu};

    use super::*;
    use tce_augment::units::Units;

    /// Labels and a generator of a population of one, trained for some updates on `t`.
    fn trained(t: &Transitions, steps: u64) -> (Generator, LabelModels) {
        let units = Units::fit(t, None, Target::Delta);
        let (d, streams, device) = (units.live.len(), [Streams::new(5)], cpu());
        let config = TrainConfig { learning_rate: 2e-3, schedule: Schedule::Cosine, batch: 64, ema: 0.99 };
        let process = Process::Edm(Edm::default());
        let states = units.states(&t.observations);
        let outputs =
            units.output.apply(&Target::Delta.encode(&units.take(&t.observations), &units.take(&t.next_observations)));
        let part = Part { rows: &states, condition: Condition::Constant(vec![0.0]) };
        let state_data = ScoreData::new(vec![part], d, 1, Balance::Rows).unwrap();
        let transition_data = ScoreData::conditioned(&outputs, d, &states, d).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let train = |name: &str, width: usize, data: ScoreData| {
            let mut trainer =
                Trainer::new(name, NetworkConfig::new(d, width), process, config, &streams, &device).unwrap();
            let mut kept = Checkpoints::open(dir.path(), name, "test").unwrap();
            trainer.train(std::slice::from_ref(&data), steps, &mut kept, |_, _| ()).unwrap();
            trainer.model()
        };
        let (state, transition) = (train("state", 1, state_data), train("transition", d, transition_data));
        let member = Member {
            streams: streams[0],
            parts: vec![Arc::new(t.clone())],
            standardizer: Standardizer::identity(t.obs_dim),
            reward_scale: 1.0,
            row_scores: None,
        };
        let labels = LabelConfig { steps, ..LabelConfig::paper() };
        let mut kept = Checkpoints::open(dir.path(), "labels", "test").unwrap();
        let models = train_labels(&[member], &labels, &mut kept, &device).unwrap().unwrap();
        (Generator { units, state, transition }, models)
    }

    /// s' = s + .5 a in one component and .9 s in the other; a = gain · s plus uniform noise.
    fn world(gain: f32, noise: f32) -> Transitions {
        let mut numbers = vec![0.0; 4 * 600];
        fill_uniform(&mut Streams::new(1).stream("world"), &mut numbers);
        let mut t = Transitions::new(2, 1);
        for u in numbers.chunks_exact(4) {
            let s = [2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0];
            let a = gain * s[0] + noise * (2.0 * u[2] - 1.0);
            t.push(&s, &[a], 0.0, &[s[0] + 0.5 * a, 0.9 * s[1]], false, false);
        }
        t
    }

    #[test]
    fn actions_of_a_linear_world_are_found_again() {
        let split: (Vec<usize>, Vec<usize>) = (0..600).partition(|i| i % 10 != 0);
        let errors = |t: &Transitions| {
            let (generator, models) = trained(t, 800);
            let actor = ImpliedActor::new(&generator, &models, 0, Sampler::SdeDpmSolver { steps: 10 }, t, &cpu());
            let found = implied_actions(&actor, t, (&split.0, &split.1), DRAWS, &Streams::new(2)).unwrap();
            (found.trained.unwrap(), found.held_out.unwrap())
        };
        // The state tells the action: spread .5 · 2 / √12.
        let (e, held_out) = errors(&world(-0.5, 0.0));
        assert_eq!((e.rows, held_out.rows, e.draws, e.lost), (540, 60, DRAWS, 0));
        assert!((e.spread - 0.289).abs() < 0.02 && e.single < 0.3 * e.spread, "{e:?}");
        assert!(held_out.single < 0.3 * held_out.spread && e.between_draws < 0.1, "{held_out:?}");
        // It does not: draws are as spread as the actions, their mean is as bad as always taking the mean, one draw √2 times worse.
        let (e, _) = errors(&world(0.0, 0.5));
        assert!((e.spread - 0.289).abs() < 0.02 && e.inverse < 0.3 * e.spread, "{e:?}");
        assert!((0.6..1.2).contains(&(e.between_draws / e.spread)), "{e:?}");
        assert!((0.85..1.2).contains(&(e.mean / e.spread)) && e.single > 1.1 * e.mean, "{e:?}");
        assert!((e.single.powi(2) - e.mean.powi(2) - e.between_draws.powi(2)).abs() < 1e-9);
    }

    #[test]
    fn rollouts_are_the_same_at_any_number_of_threads() {
        let options = tce_sim::CollectOptions { lanes: 2, ..tce_sim::CollectOptions::new(300, Streams::new(1)) };
        let t = tce_sim::collect(Agent::Hopper, Shift::Morph, &tce_sim::UniformActor, &options).unwrap();
        let (generator, models) = trained(&t, 20);
        let sampler = Sampler::SdeDpmSolver { steps: 3 };
        let actor = ImpliedActor::new(&generator, &models, 0, sampler, &t, &cpu());
        let arena = Arena::new(Agent::Hopper, Shift::Morph, tce_data::ScoreTable::Otdf);
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| rollout_implied(&actor, arena, 3, Streams::new(7)).unwrap())
        };
        let (one, two) = (on(1), on(2));
        assert_eq!(one, two);
        assert!(one.score.is_some() && one.length.unwrap() >= 1.0 && one.failed.is_none(), "{one:?}");
        let other = rollout_implied(&actor, arena, 3, Streams::new(8)).unwrap();
        assert_ne!(one.returns, other.returns, "other streams, other episodes");

        // A lane's actions are its own, whoever else is there.
        let two = &t.observations[..22];
        let rngs = || [0, 1].map(|i| Streams::new(3).indexed("lane", i));
        let both = actor.actions(two, &mut rngs()).unwrap();
        let second = actor.actions(&two[11..], &mut rngs()[1..]).unwrap();
        assert!(both[3..].iter().zip(&second).all(|(a, b)| (a - b).abs() < 1e-5), "{both:?} {second:?}");
    }
}

//! A custom learner: it clones the better half of every batch, by reward.
//!
//!     cargo run --release --example custom_learner
//!
//! A learner implements `Learner` (one update, its state for checkpoints) and `PolicyLearner` (its policies). It then
//! has the training loop, minibatches, checkpoints, several seeds at once and policy files. For `--learner`, presets
//! and reports, it also needs a configuration and a line in the registry: docs/extend.md.

use std::path::Path;
use std::sync::Arc;

use rand::RngExt;
use tce_base::Streams;
use tce_data::{Standardizer, Transitions};
use tce_learn::{
    ActorConfig, Bc, BcConfig, Buffer, LearnError, Learner, Member, Meter, Minibatch, Policy, PolicyLearner, Steps,
    train,
};
use tce_nn::{Checkpoints, NamedParameters, NetworkError, cpu, host};

/// Clones the half of every batch with the highest rewards.
struct RewardedHalf(Bc);

impl Learner for RewardedHalf {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        // [members, rows, 1]
        let [members, rows, _] = batch.r.dims();
        let rewards = host(batch.r.clone());
        let better: Vec<Vec<usize>> = (0..members)
            .map(|m| {
                let own = &rewards[m * rows..(m + 1) * rows];
                let mut order: Vec<usize> = (0..rows).collect();
                order.sort_by(|&i, &j| own[j].total_cmp(&own[i]));
                order.truncate(rows / 2);
                order
            })
            .collect();
        self.0.update(&batch.keep(&better), step, meter);
    }

    fn state(&self) -> NamedParameters {
        self.0.state()
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.0.restore(state, path)
    }
}

impl PolicyLearner for RewardedHalf {
    fn policies(&self) -> Vec<Policy> {
        self.0.policies()
    }
}

/// One log with two behaviours: a = s / 2 is rewarded, a = -s / 2 is not.
fn log() -> Transitions {
    let mut rng = Streams::new(3).stream("log");
    let mut log = Transitions::new(1, 1);
    for i in 0..2000 {
        let s = rng.random_range(-1.0f32..1.0);
        let (sign, reward) = if i % 2 == 0 { (0.5, 1.0) } else { (-0.5, 0.0) };
        log.push(&[s], &[sign * s], reward, &[s], false, true);
    }
    log
}

fn main() -> Result<(), LearnError> {
    let log = Arc::new(log());
    let standardizer = Standardizer::fit(&log.observations, log.obs_dim);
    let member =
        Member { streams: Streams::new(0), parts: vec![log], standardizer, reward_scale: 1.0, row_scores: None };
    let buffer = Buffer::new(vec![member], 128)?;
    let steps = Steps::new(1500, 0);
    let actor = ActorConfig { hidden: vec![32, 32], lr: 3e-3, ..ActorConfig::default() };
    let config = BcConfig { actor, ..BcConfig::default() };
    for (name, half) in [("all rows", false), ("the rewarded half", true)] {
        let bc = Bc::new(&buffer, &config, steps.to, &cpu())?;
        let mut learner: Box<dyn PolicyLearner> = if half { Box::new(RewardedHalf(bc)) } else { Box::new(bc) };
        let silent = |_: &_, _: &_| Ok::<_, LearnError>(());
        train(learner.as_mut(), &buffer, steps, name, &mut Checkpoints::none(), &cpu(), silent)?;
        let mut action = [0.0];
        learner.policies()[0].act(&[0.8], None, &mut action);
        println!("cloning {name}: action at 0.8 is {:.2}", action[0]);
        assert!(!half || (action[0] - 0.4).abs() < 0.1, "the rewarded behaviour");
    }
    Ok(())
}

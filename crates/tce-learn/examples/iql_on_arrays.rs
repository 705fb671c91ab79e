//! IQL on the user's own arrays: a point on a line that should be at 0, logged during a random walk.
//!
//!     cargo run --release --example iql_on_arrays
//!
//! Two seeds are trained as one population. The learned actions move the point to 0; the logged ones never did.

use std::sync::Arc;

use rand::RngExt;
use tce_base::Streams;
use tce_data::{Standardizer, Transitions};
use tce_learn::regulariser::Regulariser;
use tce_learn::{Buffer, Iql, IqlConfig, LearnError, Member, PolicyLearner, Steps, train};
use tce_nn::{Checkpoints, cpu};

/// 4000 steps of a random walk: s' = s + a / 5, r = -|s'|, episodes of 20 steps.
fn wander() -> Transitions {
    let mut rng = Streams::new(7).stream("wander");
    let mut log = Transitions::new(1, 1);
    let mut s = 0.0f32;
    for i in 0..4000 {
        if i % 20 == 0 {
            s = rng.random_range(-1.0..1.0);
        }
        let a = rng.random_range(-1.0f32..1.0);
        let next = s + a / 5.0;
        log.push(&[s], &[a], -next.abs(), &[next], false, i % 20 == 19);
        s = next;
    }
    log
}

fn main() -> Result<(), LearnError> {
    let log = Arc::new(wander());
    let member = |seed| Member {
        streams: Streams::new(seed),
        parts: vec![log.clone()],
        standardizer: Standardizer::fit(&log.observations, log.obs_dim),
        reward_scale: 1.0,
        row_scores: None,
    };
    let buffer = Buffer::new(vec![member(0), member(1)], 128)?;
    // Greedier than the usual settings, because the log is from an aimless policy.
    let config = IqlConfig { expectile: 0.9, temperature: 10.0, hidden: vec![64, 64], ..IqlConfig::paper() };
    let steps = Steps::new(3000, 1000);
    let mut iql = Iql::new(&buffer, &config, Regulariser::None, steps.to, &cpu())?;
    train(&mut iql, &buffer, steps, "IQL", &mut Checkpoints::none(), &cpu(), |report, _| {
        println!("step {}: {:.3?}", report.step, report.metrics);
        Ok::<_, LearnError>(())
    })?;
    for (seed, policy) in iql.policies().iter().enumerate() {
        let mut actions = [0.0; 3];
        policy.act(&[-0.8, 0.0, 0.8], None, &mut actions);
        println!("seed {seed}: actions at -0.8, 0 and 0.8: {actions:.2?}");
        assert!(actions[0] > 0.2 && actions[2] < -0.2, "the point is pulled to 0");
    }
    Ok(())
}

//! Measures learners: `cargo run --release -p tce-learn --example updates_per_second [MEMBERS] [STEPS] [bc|iql|act]`.
//! HalfCheetah's shape: 17 observations, 6 actions, 128 + 128 rows, 256-256 networks.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Instant;

use tce_base::{Streams, random::fill_normal};
use tce_data::{Standardizer, Transitions};
use tce_learn::iql::{Iql, IqlConfig};
use tce_learn::regulariser::Regulariser;
use tce_learn::{Bc, BcConfig, Buffer, Learner, Member, PolicyLearner, Steps, train};
use tce_nn::cpu;

fn table(seed: u64, rows: usize) -> Arc<Transitions> {
    let mut t = Transitions::new(17, 6);
    let mut row = [0.0; 41];
    let mut rng = Streams::new(seed).stream("rows");
    for _ in 0..rows {
        fill_normal(&mut rng, &mut row);
        t.push(
            &row[..17],
            &row[17..23].iter().map(|a| a.tanh()).collect::<Vec<_>>(),
            row[23],
            &row[24..41],
            false,
            true,
        );
    }
    Arc::new(t)
}

/// Microseconds per call of a policy, as evaluation uses it.
fn act(buffer: &Buffer, calls: u64) {
    let policy = Bc::new(buffer, &BcConfig::default(), 1, &cpu()).expect("defaults").policies().remove(0);
    for rows in [1, 10, 64] {
        let (observations, mut actions) = (vec![0.5; rows * 17], vec![0.0; rows * 6]);
        let begin = Instant::now();
        (0..calls).for_each(|_| policy.act(&observations, None, &mut actions));
        println!("{rows} rows: {:.1} µs per call", begin.elapsed().as_secs_f64() * 1e6 / calls as f64);
    }
}

fn main() {
    let argument = |k: usize, default: &str| std::env::args().nth(k).unwrap_or_else(|| default.into());
    let members: u64 = argument(1, "1").parse().expect("a number of members");
    let steps: u64 = argument(2, "500").parse().expect("a number of steps");
    let parts = vec![table(1, 5_000), table(2, 200_000)];
    let member = |seed| Member {
        streams: Streams::new(seed),
        parts: parts.clone(),
        standardizer: Standardizer::identity(17),
        reward_scale: 1.0,
    };
    let buffer = Buffer::new((0..members).map(member).collect(), 256).expect("good data");
    if argument(3, "iql") == "act" {
        return act(&buffer, steps);
    }
    let mut learner: Box<dyn Learner> = match argument(3, "iql").as_str() {
        "bc" => Box::new(Bc::new(&buffer, &BcConfig::default(), steps, &cpu()).expect("defaults")),
        _ => Box::new(Iql::new(&buffer, &IqlConfig::default(), Regulariser::None, steps, &cpu()).expect("defaults")),
    };
    let run = |learner: &mut dyn Learner, count| {
        let begin = Instant::now();
        train(learner, &buffer, Steps::new(count, 0), "updates", &cpu(), |_, _| Ok::<_, Infallible>(())).unwrap();
        begin.elapsed().as_secs_f64()
    };
    run(&mut *learner, 20);
    let seconds = run(&mut *learner, steps);
    let begin = Instant::now();
    (0..steps).for_each(|step| drop(buffer.sample(step, &cpu())));
    let gather = begin.elapsed().as_secs_f64() / seconds;
    println!(
        "{members} members: {:.1} updates/s, {:.1} member updates/s; making batches is {:.1} % of it",
        steps as f64 / seconds,
        (steps * members) as f64 / seconds,
        100.0 * gather
    );
}

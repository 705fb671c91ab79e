//! Meta-DT end to end on small problems, and what must hold of it whatever it learns.

use std::sync::Arc;

use tce_base::{Streams, random::fill_normal};
use tce_data::{Standardizer, Transitions};
use tce_learn::Meter;
use tce_learn::{Buffer, Learner, Member, MetaDt, MetaDtConfig};
use tce_nn::cpu;

/// Updates per second at HalfCheetah's size on one core: `cargo test --release -p tce-learn --test meta_dt -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
fn speed() {
    let mut t = Transitions::new(17, 6);
    let mut row = vec![0.0; 17 + 6 + 1 + 17];
    for i in 0..20_000 {
        fill_normal(&mut Streams::new(0).indexed("row", i), &mut row);
        t.push(&row[..17], &row[17..23], row[23], &row[24..], false, i % 1000 == 999);
    }
    let t = Arc::new(t);
    let standardizer = Standardizer::identity(17);
    let member = Member { streams: Streams::new(0), parts: vec![t.clone(), t], standardizer, reward_scale: 1.0 };
    let buffer = Buffer::new(vec![member], 256).unwrap();
    let mut config = MetaDtConfig::default();
    config.world_model.steps = 100;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| {
        let mut learner = MetaDt::new(&buffer, &config, &cpu()).unwrap();
        let batch = buffer.sample(0, &cpu());
        let mut meter = Meter::always();
        for (name, from, to) in [("world model", 5, 100), ("transformer", 101, 121)] {
            learner.update(&batch, from - 1, &mut meter);
            let started = std::time::Instant::now();
            (from..to).for_each(|step| learner.update(&batch, step, &mut meter));
            println!("{name}: {:.1} updates/s", (to - from) as f64 / started.elapsed().as_secs_f64());
        }
    });
}

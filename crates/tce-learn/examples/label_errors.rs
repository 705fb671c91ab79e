//! Held-out errors of the label models on a target file, for each variant of the input and the learning rate schedule:
//! `cargo run --release -p tce-learn --example label_errors TARGET.hdf5 [STEPS]`.

use std::path::Path;
use std::sync::Arc;

use tce_base::Streams;
use tce_data::{LoadOptions, Standardizer, load};
use tce_learn::pair_model::{PairConfig, PairInput};
use tce_learn::{LabelConfig, Member, train_labels};
use tce_nn::{Checkpoints, cpu};

fn main() {
    let path = std::env::args().nth(1).expect("a file");
    let steps = std::env::args().nth(2).map_or(5_000, |s| s.parse().expect("a number of steps"));
    let data = load(Path::new(&path), &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}")).transitions;
    let parts = vec![Arc::new(data)];
    let standardizer = Standardizer::identity(parts[0].obs_dim);
    let member = |seed| Member {
        streams: Streams::new(seed),
        parts: parts.clone(),
        standardizer: standardizer.clone(),
        reward_scale: 1.0,
        row_scores: None,
    };
    let default = PairConfig::default();
    for (name, model) in [
        ("delta, cosine, drop .1", default.clone()),
        ("delta, constant, drop .1", PairConfig { cosine: false, ..default.clone() }),
        ("delta, cosine, drop 0", PairConfig { drop_path: 0.0, ..default.clone() }),
        ("next, cosine, drop .1", PairConfig { input: PairInput::Next, ..default.clone() }),
    ] {
        let config = LabelConfig { model, steps, ..LabelConfig::paper() };
        let models = train_labels(&[member(1)], &config, &mut Checkpoints::none(), &cpu())
            .expect("good data")
            .expect("not interrupted");
        for errors in models.errors() {
            println!("{name}: {:?}", errors.expect("rows held out"));
        }
    }
}

//! Replays the public data sets.

use std::path::PathBuf;

use tce_data::{Agent, LoadOptions, Shift, load};
use tce_sim::replay;

#[test]
fn every_public_target_data_set_is_reproduced() {
    let shared = std::env::var_os("TCE_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared"), PathBuf::from);
    let mut found = 0;
    for agent in Agent::ALL {
        for shift in Shift::ALL {
            for quality in ["medium", "medium_expert", "expert"] {
                let name = format!("{agent}_{}_{quality}.hdf5", shift.file_name());
                let path = shared.join("datasets/otdf").join(&name);
                if !path.exists() {
                    continue;
                }
                found += 1;
                let data = load(&path, &LoadOptions::default()).unwrap().transitions;
                let report = replay(agent, shift, &data, None).unwrap();
                assert!(report.passes(), "{name}: {report:#?}");
            }
        }
    }
    if found == 0 {
        eprintln!("SKIPPED: every_public_target_data_set_is_reproduced needs TCE_SHARED (datasets/otdf)");
    }
}

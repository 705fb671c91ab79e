//! Trained source actors from other projects in the shared folder, for robots that the zoo does not cover.

use std::path::{Path, PathBuf};

use tce_data::Agent;

use crate::recipes::{Cast, Part};

/// The folder with stand-in actors and the public target sets: `TCE_SHARED`, by default `../shared`.
pub fn shared_folder() -> PathBuf {
    std::env::var_os("TCE_SHARED").map_or_else(|| PathBuf::from("../shared"), PathBuf::from)
}

/// The actors under `shared/policies` whose behaviour is closest to that in D4RL's data sets (source domain). Weights
/// are calibrated so that mean returns are within 10 % of D4RL's. A part is empty if one of its actors is missing.
pub fn cast(agent: Agent, shared: &Path) -> Cast {
    use Agent::*;
    let medium: &[(&str, f64)] = match agent {
        HalfCheetah => &[("yth_sac_halfcheetah_seed1_B_20201001_0803_e9a4951", 1.0)],
        Hopper => &[("zoo_sac_hopper_final", 0.7), ("yth_sac_hopper_seed4_C_20201001_0828_6ebb228", 0.3)],
        Walker2d => &[("yth_sac_walker2d_seed4_D_20201002_0053_baba2dc", 0.56), ("zoo_tqc_walker2d_final", 0.44)],
        Ant => &[("yth_sac_ant_seed0_A_20201001_0516_32b71a2", 1.0)],
    };
    let expert: &[(&str, f64)] = match agent {
        HalfCheetah => &[("yth_sac_halfcheetah_seed3_D_20201002_0053_baba2dc", 1.0)],
        Hopper => &[("yth_sac_hopper_seed2_D_20201002_0053_baba2dc", 1.0)],
        Walker2d => &[("yth_sac_walker2d_seed5_D_20201002_0053_baba2dc", 1.0)],
        Ant => &[("yth_sac_ant_seed5_D_20201002_0053_baba2dc", 1.0)],
    };
    // Early stages of training, then the medium actor, in shares like those of a replay buffer.
    let replay: &[(&str, f64)] = match agent {
        HalfCheetah => &[
            ("yth_sac_halfcheetah_seed5_B_20201001_0803_e9a4951", 0.15),
            ("yth_sac_halfcheetah_seed3_B_20201001_0803_e9a4951", 0.2),
            ("yth_sac_halfcheetah_seed4_B_20201001_0803_e9a4951", 0.3),
            ("yth_sac_halfcheetah_seed1_B_20201001_0803_e9a4951", 0.35),
        ],
        Hopper => &[
            ("yth_sac_hopper_seed1_B_20201001_0803_e9a4951", 0.25),
            ("yth_sac_hopper_seed3_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_hopper_seed2_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_hopper_seed4_C_20201001_0828_6ebb228", 0.25),
        ],
        Walker2d => &[
            ("yth_sac_walker2d_seed1_B_20201001_0803_e9a4951", 0.15),
            ("yth_sac_walker2d_seed4_C_20201001_0828_6ebb228", 0.15),
            ("yth_sac_walker2d_seed3_C_20201001_0828_6ebb228", 0.15),
            ("yth_sac_walker2d_seed1_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_walker2d_seed4_D_20201002_0053_baba2dc", 0.3),
        ],
        Ant => &[
            ("yth_sac_ant_seed1_B_20201001_0803_e9a4951", 0.3),
            ("yth_sac_ant_seed1_C_20201001_0828_6ebb228", 0.4),
            ("yth_sac_ant_seed0_A_20201001_0516_32b71a2", 0.3),
        ],
    };
    let parts = |actors: &[(&str, f64)]| {
        let actor = |name: &str| shared.join(format!("policies/{name}.npz"));
        let parts: Vec<_> = actors.iter().map(|&(name, weight)| Part { actor: actor(name), weight }).collect();
        if parts.iter().all(|p| p.actor.exists()) { parts } else { Vec::new() }
    };
    Cast { medium: parts(medium), expert: parts(expert), replay: parts(replay) }
}

//! One file per algorithm, and the code that several of them share.

pub mod bc;
pub mod bc_dropout;
pub mod bosa;
pub mod dara;
pub mod deterministic;
pub mod dmc;
pub mod igdf;
pub mod iql;
pub(crate) mod iql_config;
pub mod meta_dt;
pub mod method;
pub mod on_iql;
pub mod otdf;
pub mod rebrac;
pub mod regulariser;
pub mod sac;
pub mod selection;
pub mod srpo;
pub mod td3_bc;

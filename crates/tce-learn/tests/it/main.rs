//! Tests of `tce-learn` from outside. One binary: linking each file by itself takes longer than the tests.

mod common;
mod import;
mod labels;
mod learners;
mod meta_dt;
mod prior_methods;
mod sac;
mod tables;

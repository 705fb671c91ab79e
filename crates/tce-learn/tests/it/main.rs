//! Integration tests of `tce-learn`, in one binary: linking each file separately takes longer than the tests.

mod buffer;
mod common;
mod import;
mod labels;
mod learners;
mod meta_dt;
mod prior_methods;
mod sac;
mod tables;

//! Tests of `tce-sim` from outside. One binary: linking each file by itself takes longer than the tests.

mod environments;
mod models;
mod public_data;
mod rollouts;
mod video;

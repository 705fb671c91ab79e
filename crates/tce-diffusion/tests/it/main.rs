//! Tests of `tce-diffusion` from outside. One binary: linking each file by itself takes longer than the tests.

mod golden;
mod model;

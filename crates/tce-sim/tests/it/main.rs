//! Integration tests of `tce-sim`, in one binary: linking each file separately takes longer than the tests.

mod environments;
mod models;
mod public_data;
mod rollouts;
mod video;

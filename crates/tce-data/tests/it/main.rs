//! Integration tests of `tce-data`, in one binary: linking each file separately takes longer than the tests.

mod common;
mod episodes;
mod files;
mod formats;
mod h5py;
mod links;
mod malformed;
mod mixed_data;
mod real_files;
mod speed;
mod styles;
mod versions;

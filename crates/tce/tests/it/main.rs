//! The program, end to end. One binary: linking each file by itself takes longer than the tests.

mod bad_input;
mod clones;
mod common;
mod diagnose;
mod gpu;
mod interrupted;
mod metrics;
mod mistakes;
mod moved;
mod own_robots;
mod pipeline;
mod report;
mod sac;
mod slurm;
mod sweep;
mod terminal;
mod video;
mod zoo;

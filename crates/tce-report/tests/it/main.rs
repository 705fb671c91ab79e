//! Tests of `tce-report` from outside. One binary: linking each file by itself takes longer than the tests.

mod browser;
mod common;
mod record;
mod report;
mod words;

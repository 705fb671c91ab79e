//! The `tce` program: see the library.

use std::process::ExitCode;

use clap::Parser;

/// A training step allocates and frees megabytes of activations. The system's allocator gives them back to the kernel
/// and takes them again, page fault by page fault: a fifth of the time of an IQL update.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    tce_base::listen_for_interrupts();
    // clap itself answers a wrong call with exit code 2.
    match tce::Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let code = error.exit_code();
            eprintln!("{:?}", miette::Report::new(error));
            ExitCode::from(code as u8)
        }
    }
}

//! The `tce` program: see the library.

use std::process::ExitCode;

use clap::Parser;

/// A training step allocates and frees megabytes of activations. The system's allocator gives them back to the kernel
/// and takes them again, page fault by page fault: a fifth of the time of an IQL update.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Memory that is free stays with the process: giving it back between the steps of a training, and taking it again, was a
/// tenth of an IQL update.
fn keep_free_memory() {
    // The option's number in mimalloc 2 and 3; the bindings do not name it.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = libmimalloc_sys::mi_option_use_numa_nodes - 1;
    // SAFETY: an option that the allocator reads whenever it frees pages.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, -1) };
}

fn main() -> ExitCode {
    keep_free_memory();
    tce_base::listen_for_interrupts();
    // clap itself answers a wrong call with exit code 2.
    match tce::Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let code = error.exit_code();
            eprint!("{}", tce::told(&error));
            ExitCode::from(code as u8)
        }
    }
}

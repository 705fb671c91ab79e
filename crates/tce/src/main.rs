//! The `tce` program: see the library.

use std::process::ExitCode;

/// A training step allocates and frees megabytes of activations. The system's allocator gives them back to the kernel
/// and takes them again, page fault by page fault: a fifth of the time of an IQL update.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    tce::allocator::keep_free_memory();
    tce_base::listen_for_interrupts();
    match tce::Cli::of_command_line().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // The line above the bars goes away before the error stands below them.
            tce_base::end_course(tce_base::LastStep::BrokenOff);
            let code = error.exit_code();
            eprint!("{}", tce::told(&error));
            ExitCode::from(code as u8)
        }
    }
}

//! How the allocator of the program, and of the Python module, is set.

/// Memory that is free stays with the process: giving it back between the steps of a training, and taking it again, was a
/// tenth of an IQL update.
pub fn keep_free_memory() {
    // The option's number in mimalloc 2 and 3; the bindings do not name it.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = libmimalloc_sys::mi_option_use_numa_nodes - 1;
    // SAFETY: an option that the allocator reads whenever it frees pages.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, -1) };
}

//! libmujoco, opened when the simulator is first used.
//!
//! What needs no simulator runs where MuJoCo is not installed, and a copied program finds the library beside itself.
//! `mujoco-rs` calls MuJoCo's functions by their names and expects a linker to know them. The linker finds them here:
//! every one is a function of ours that jumps to an address, and [`open`] fills in the addresses. Unlike trampolines in
//! assembler, these work on any processor, and the compiler compares their signatures with those of `mujoco-rs`. Tables of
//! data that MuJoCo exports cannot be had this way; `mujoco-rs` uses none.
//!
//! A function that is missing from the list shows when a binary is linked: `undefined symbol: mj_...`. Add it.

use std::env;
use std::ffi::{CStr, c_char, c_int, c_void};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Mutex, PoisonError};

use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
use mujoco_rs::mujoco_c::{mjData, mjLogConfig, mjModel, mjVFS, mjfLogHandler, mjtNum};

use crate::SimError;
use crate::error::{FILE, LibraryError, VARIABLE, VERSION};

/// Where the build script put the library: for `cargo run`, tests and benches.
const BUILT_WITH: Option<&str> = option_env!("TCE_MUJOCO_BUILD_DIR");

/// Opens libmujoco, unless it is open, and returns where it lies.
///
/// It is looked for where `TCE_MUJOCO_LIB` says; if that is not set, beside the program, in `../lib` of there, where the
/// build put it, and where the system's loader looks (`LD_LIBRARY_PATH`). The first file counts, good or bad.
///
/// # Errors
/// If there is none, or if it is not MuJoCo 3.17.0.
pub fn open() -> Result<PathBuf, SimError> {
    static OPENED: Mutex<Option<PathBuf>> = Mutex::new(None);
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(path) = &*opened {
        return Ok(path.clone());
    }
    // Without it, MuJoCo ends the process by an illegal instruction.
    #[cfg(target_arch = "x86_64")]
    if !is_x86_feature_detected!("avx") {
        return Err(LibraryError::Processor.into());
    }
    let path = find()?;
    load(&path)?;
    Ok(opened.insert(path).clone())
}

/// The library to use. The last resort is the bare name, which leaves the search to the system.
fn find() -> Result<PathBuf, LibraryError> {
    if let Some(path) = env::var_os(VARIABLE).filter(|v| !v.is_empty()) {
        let path = PathBuf::from(path);
        // With a folder in front, the loader does not search for it.
        let absolute = std::path::absolute(&path).unwrap_or_else(|_| path.clone());
        return if absolute.is_file() { Ok(absolute) } else { Err(LibraryError::Named { path }) };
    }
    let places = places(env::current_exe().ok().as_deref());
    if let Some(found) = places.iter().find(|p| p.is_file()) {
        return Ok(found.clone());
    }
    // SAFETY: MuJoCo's initialisers register its decoders and touch nothing of ours.
    if unsafe { Library::open(Some(FILE), RTLD_NOW | RTLD_LOCAL) }.map(std::mem::forget).is_ok() {
        return Ok(PathBuf::from(FILE));
    }
    let mut text = format!("  {VARIABLE}: not set\n");
    for place in places {
        let _ = writeln!(text, "  {}", place.display());
    }
    text += "  the system's loader (LD_LIBRARY_PATH, ldconfig)\n";
    Err(LibraryError::Missing { places: text })
}

/// Files to try, for the program `program`.
fn places(program: Option<&Path>) -> Vec<PathBuf> {
    let beside = program.and_then(Path::parent);
    let lib = beside.and_then(Path::parent).map(|prefix| prefix.join("lib"));
    let folders = [beside.map(Path::to_owned), lib, BUILT_WITH.map(PathBuf::from)];
    folders.into_iter().flatten().map(|folder| folder.join(FILE)).collect()
}

/// Opens `path` for good and takes the addresses from it.
fn load(path: &Path) -> Result<(), LibraryError> {
    let unusable = |reason: String| LibraryError::Unusable { path: path.to_owned(), reason };
    let system = |e: libloading::Error| {
        let detail = std::error::Error::source(&e).map_or_else(|| e.to_string(), ToString::to_string);
        unusable(detail)
    };
    // SAFETY: MuJoCo's initialisers register its decoders and touch nothing of ours.
    let library = unsafe { Library::open(Some(path), RTLD_NOW | RTLD_LOCAL) }.map_err(system)?;
    // SAFETY: this is the function's type in every version of MuJoCo, and it returns a constant string.
    let found = unsafe {
        let version = library.get::<unsafe extern "C" fn() -> *const c_char>(c"mj_versionString".to_bytes_with_nul());
        CStr::from_ptr((version.map_err(system)?)()).to_string_lossy().into_owned()
    };
    if found != VERSION {
        return Err(LibraryError::Version { path: path.to_owned(), found });
    }
    FUNCTIONS.fill(&library).map_err(system)?;
    // The addresses stay valid until the process ends.
    std::mem::forget(library);
    Ok(())
}

/// What stands in the table until [`open`] has filled it.
extern "C" fn closed() -> ! {
    eprintln!("MuJoCo was called before it was opened: a fault of this program (see tce-sim/src/library.rs)");
    std::process::abort()
}

/// Defines the table of addresses and the functions that jump to them.
macro_rules! forward {
    ($(fn $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?;)*) => {
        /// Where MuJoCo's functions lie.
        #[expect(non_snake_case, reason = "C's names")]
        struct Functions {
            $($name: AtomicPtr<c_void>,)*
        }

        static FUNCTIONS: Functions = Functions {
            $($name: AtomicPtr::new(closed as extern "C" fn() -> ! as *mut c_void),)*
        };

        impl Functions {
            fn fill(&self, library: &Library) -> Result<(), libloading::Error> {
                $(
                    // SAFETY: only the address is taken here.
                    let address = unsafe { library.get::<*mut c_void>(concat!(stringify!($name), "\0").as_bytes())? };
                    self.$name.store(address.as_raw_ptr(), Ordering::Relaxed);
                )*
                Ok(())
            }
        }

        $(
            // The same type as in the bindings, or it does not compile.
            const _: unsafe extern "C" fn($($type),*) $(-> $result)? = mujoco_rs::mujoco_c::$name;

            /// MuJoCo's function of this name.
            #[unsafe(no_mangle)]
            unsafe extern "C" fn $name($($argument: $type),*) $(-> $result)? {
                // A relaxed load: whoever comes here went through the lock in `open`.
                let address = FUNCTIONS.$name.load(Ordering::Relaxed);
                // SAFETY: the address of the C function of this name in MuJoCo 3.17.0, for which the bindings were made; or
                // `closed`, which takes nothing and does not return.
                unsafe {
                    let function: unsafe extern "C" fn($($type),*) $(-> $result)? = std::mem::transmute(address);
                    function($($argument),*)
                }
            }
        )*
    };
}

forward! {
    fn mj_addBufferVFS(vfs: *mut mjVFS, name: *const c_char, buffer: *const c_void, size: c_int) -> c_int;
    fn mj_defaultVFS(vfs: *mut mjVFS);
    fn mj_deleteData(data: *mut mjData);
    fn mj_deleteModel(model: *mut mjModel);
    fn mj_deleteVFS(vfs: *mut mjVFS);
    fn mj_forward(model: *const mjModel, data: *mut mjData);
    fn mj_getTotalmass(model: *const mjModel) -> mjtNum;
    fn mj_id2name(model: *const mjModel, kind: c_int, id: c_int) -> *const c_char;
    fn mj_kinematics(model: *const mjModel, data: *mut mjData);
    fn mj_loadXML(file: *const c_char, vfs: *const mjVFS, error: *mut c_char, size: c_int) -> *mut mjModel;
    fn mj_makeData(model: *const mjModel) -> *mut mjData;
    fn mj_name2id(model: *const mjModel, kind: c_int, name: *const c_char) -> c_int;
    fn mj_resetData(model: *const mjModel, data: *mut mjData);
    fn mj_step(model: *const mjModel, data: *mut mjData);
    fn mj_version() -> c_int;
    fn mj_versionString() -> *const c_char;
    fn mju_getLogConfig() -> mjLogConfig;
    fn mju_setLogConfig(config: mjLogConfig);
    fn mju_setLogHandler(handler: mjfLogHandler) -> mjfLogHandler;
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use super::*;

    #[test]
    fn a_program_looks_beside_itself_and_in_the_lib_of_its_prefix() {
        let places = places(Some(Path::new("/opt/tce/bin/tce")));
        assert_eq!(places[0], Path::new("/opt/tce/bin/libmujoco.so.3.17.0"));
        assert_eq!(places[1], Path::new("/opt/tce/lib/libmujoco.so.3.17.0"));
        assert!(places[2].is_file(), "the build's own: {}", places[2].display());
    }

    #[test]
    fn a_file_that_is_no_library_is_named_with_what_the_system_says() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        let message = load(&path).unwrap_err().to_string();
        assert!(message.contains("Cargo.toml: this is not a MuJoCo"), "{message}");
        assert!(message.contains("invalid ELF header"), "{message}");
    }

    #[test]
    fn the_library_is_opened_once_and_is_where_it_was() {
        let first = open().unwrap();
        assert_eq!(first.file_name(), Some(OsStr::new(FILE)));
        assert_eq!(open().unwrap(), first);
        // SAFETY: takes nothing and returns a number.
        assert_eq!(unsafe { mj_version() }, 3_017_000);
    }
}

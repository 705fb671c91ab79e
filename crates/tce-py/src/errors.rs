//! Errors as the package's exceptions, in the same words as the command line.

use pyo3::prelude::*;
use tce_run::Error;

/// The exception `name` of `tce.errors` with this message.
pub fn exception(py: Python<'_>, name: &str, message: String) -> PyErr {
    let class = py.import("tce.errors").and_then(|module| module.getattr(name));
    class.and_then(|class| class.call1((message,))).map_or_else(|error| error, PyErr::from_value)
}

/// The exception for an error of the program.
pub fn raised(py: Python<'_>, error: &Error) -> PyErr {
    let name = match error {
        _ if error.exit_code() == 130 => "Interrupted",
        Error::Usage(_) => "ConfigError",
        Error::Data(_) | Error::Agents(_) => "DataError",
        _ => "Error",
    };
    exception(py, name, error.to_string())
}

/// Errors of the program where Python waits for a result.
pub trait Raise<T> {
    /// The result, or the exception.
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T, E: Into<Error>> Raise<T> for Result<T, E> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| raised(py, &error.into()))
    }
}

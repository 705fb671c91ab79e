//! What training says while it runs: JSON lines for programs, TensorBoard events for eyes.

use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Map, Value, json};
use tce_base::FileError;

/// The metrics of one stage, written line by line: what a killed run had is there to be looked at.
pub struct Metrics {
    path: PathBuf,
    lines: BufWriter<File>,
    events_root: PathBuf,
    events: Vec<Events>,
}

impl Metrics {
    /// Starts `metrics.jsonl` and `tensorboard/` in `directory` anew: a stage that was interrupted is done again from its
    /// beginning, and so are its metrics.
    pub fn start(directory: &Path) -> Result<Self, FileError> {
        fs::create_dir_all(directory).map_err(|e| FileError::new(directory, "create the directory", e))?;
        let path = directory.join("metrics.jsonl");
        let file = File::create(&path).map_err(|e| FileError::new(&path, "create", e))?;
        let events_root = directory.join("tensorboard");
        match fs::remove_dir_all(&events_root) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::new(&events_root, "remove the old", e));
            }
            _ => {}
        }
        Ok(Self { path, lines: BufWriter::new(file), events_root, events: Vec::new() })
    }

    /// Goes on with what is in `directory`, cut back to the first `step` steps: a killed program may have written more than its
    /// checkpoint knows.
    pub fn resume(directory: &Path, step: u64) -> Result<Self, FileError> {
        let path = directory.join("metrics.jsonl");
        let old = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(FileError::new(&path, "read", e)),
        };
        let mut metrics = Self::start(directory)?;
        // The last line may be half written.
        for line in old.lines().filter_map(|line| serde_json::from_str::<Map<String, Value>>(line).ok()) {
            let number = |name: &str| line.get(name).and_then(Value::as_u64);
            let (Some(at), Some(member)) = (number("step"), number("member")) else { continue };
            let stage = line.get("stage").and_then(Value::as_str).unwrap_or_default();
            let figures = line.iter().filter(|(name, _)| !matches!(name.as_str(), "step" | "member" | "stage"));
            let figures = figures.map(|(name, value)| (name.as_str(), value.as_f64().unwrap_or(f64::NAN)));
            if at <= step {
                metrics.log(stage, at, member as usize, figures)?;
            }
        }
        Ok(metrics)
    }

    /// Records `values` of `member` of the population after `step` steps of `stage`.
    pub fn log<'a>(
        &mut self,
        stage: &str,
        step: u64,
        member: usize,
        values: impl IntoIterator<Item = (&'a str, f64)>,
    ) -> Result<(), FileError> {
        let values: Vec<_> = values.into_iter().collect();
        let mut line = Map::new();
        line.insert("stage".into(), json!(stage));
        line.insert("step".into(), json!(step));
        line.insert("member".into(), json!(member));
        line.extend(values.iter().map(|&(name, value)| (name.to_owned(), Value::from(value))));
        let failed = |e| FileError::new(&self.path, "write", e);
        writeln!(self.lines, "{}", Value::Object(line)).and_then(|()| self.lines.flush()).map_err(failed)?;
        while self.events.len() <= member {
            let directory = self.events_root.join(format!("member-{}", self.events.len()));
            self.events.push(Events::create(&directory)?);
        }
        self.events[member].scalars(step, values.iter().map(|&(name, value)| (format!("{stage}/{name}"), value)))
    }
}

/// A TensorBoard event file: TFRecord frames around `Event` protocol buffers, of which scalars need five fields.
struct Events {
    path: PathBuf,
    file: File,
}

impl Events {
    fn create(directory: &Path) -> Result<Self, FileError> {
        fs::create_dir_all(directory).map_err(|e| FileError::new(directory, "create the directory", e))?;
        let path = directory.join(format!("events.out.tfevents.{}.tce", now() as u64));
        let file = OpenOptions::new().create(true).append(true).open(&path);
        let mut events = Self { file: file.map_err(|e| FileError::new(&path, "open", e))?, path };
        let mut event = Vec::new();
        field_fixed64(&mut event, 1, now().to_le_bytes());
        field_bytes(&mut event, 3, b"brain.Event:2");
        events.write(&event)?;
        Ok(events)
    }

    fn scalars(&mut self, step: u64, values: impl Iterator<Item = (String, f64)>) -> Result<(), FileError> {
        let mut summary = Vec::new();
        for (tag, value) in values {
            let mut v = Vec::new();
            field_bytes(&mut v, 1, tag.as_bytes());
            v.push(2 << 3 | 5); // simple_value: fixed 32
            v.extend((value as f32).to_le_bytes());
            field_bytes(&mut summary, 1, &v);
        }
        let mut event = Vec::new();
        field_fixed64(&mut event, 1, now().to_le_bytes());
        event.push(2 << 3);
        varint(&mut event, step);
        field_bytes(&mut event, 5, &summary);
        self.write(&event)
    }

    fn write(&mut self, event: &[u8]) -> Result<(), FileError> {
        let frame = frame(event);
        self.file.write_all(&frame).map_err(|e| FileError::new(&self.path, "write", e))
    }
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// TFRecord: length, masked CRC-32C of the length, data, masked CRC-32C of the data.
fn frame(data: &[u8]) -> Vec<u8> {
    let masked = |bytes: &[u8]| crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes();
    let length = (data.len() as u64).to_le_bytes();
    let mut out = Vec::with_capacity(data.len() + 16);
    out.extend(length);
    out.extend(masked(&length));
    out.extend(data);
    out.extend(masked(data));
    out
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn field_bytes(out: &mut Vec<u8>, number: u8, bytes: &[u8]) {
    out.push(number << 3 | 2);
    varint(out, bytes.len() as u64);
    out.extend(bytes);
}

fn field_fixed64(out: &mut Vec<u8>, number: u8, bytes: [u8; 8]) {
    out.push(number << 3 | 1);
    out.extend(bytes);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_has_the_published_layout() {
        // Masked CRC-32C of eight zero bytes, as TensorFlow writes it for an empty record's length.
        let frame = frame(b"");
        assert_eq!(frame.len(), 16);
        assert_eq!(frame[8..12], crc32c::crc32c(&[0; 8]).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes());
        let mut out = Vec::new();
        varint(&mut out, 300);
        assert_eq!(out, [0xac, 0x02]); // the example of the protocol-buffers specification
    }

    #[test]
    fn lines_are_json_and_events_are_written() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::start(dir.path()).unwrap();
        metrics.log("learn", 10, 1, [("loss", 0.5), ("score", 61.7)]).unwrap();
        let text = fs::read_to_string(dir.path().join("metrics.jsonl")).unwrap();
        let line: Value = serde_json::from_str(text.trim()).unwrap();
        assert_eq!(line, json!({"stage": "learn", "step": 10, "member": 1, "loss": 0.5, "score": 61.7}));
        let events = fs::read_dir(dir.path().join("tensorboard/member-1")).unwrap().next().unwrap().unwrap();
        let bytes = fs::read(events.path()).unwrap();
        assert!(bytes.windows(10).any(|w| w == b"learn/loss"));
    }
}

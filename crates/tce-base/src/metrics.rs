//! Metrics of a training while it runs: JSON lines for programs, TensorBoard events for people.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::{FileError, create_folder, read_if_there, write_atomically};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The metrics of one stage, written line by line: a killed run leaves what it had.
pub struct Metrics {
    path: PathBuf,
    lines: BufWriter<File>,
    events_root: PathBuf,
    events: Vec<Events>,
}

impl Metrics {
    /// Starts `metrics.jsonl` and `tensorboard/` in `directory`, or appends to what is there, without the lines for
    /// whose stage and step `keep` is false: a killed program may have written more than its checkpoint knows.
    pub fn resume(directory: &Path, keep: impl Fn(&str, u64) -> bool) -> Result<Self, FileError> {
        Self::resume_behind(directory, Vec::new(), keep)
    }

    /// The same with `first` before what is kept, for what is known anew at every start.
    pub fn resume_behind(
        directory: &Path,
        first: Vec<Line>,
        keep: impl Fn(&str, u64) -> bool,
    ) -> Result<Self, FileError> {
        create_folder(directory)?;
        let path = directory.join("metrics.jsonl");
        let old = read_if_there(&path)?.unwrap_or_default();
        let old = String::from_utf8_lossy(&old);
        // The last line may be half written.
        let lines = old.lines().filter_map(|line| Some((line, serde_json::from_str::<Line>(line).ok()?)));
        let first = first.into_iter().map(|line| (line.text(), line));
        let kept = lines.filter(|(_, line)| keep(&line.stage, line.step)).map(|(text, line)| (text.to_owned(), line));
        let kept: Vec<_> = first.chain(kept).collect();
        let text: String = kept.iter().map(|(line, _)| format!("{line}\n")).collect();
        write_atomically(&path, text.as_bytes())?;
        let file = OpenOptions::new().append(true).open(&path).map_err(|e| FileError::new(&path, "open", e))?;
        let events_root = directory.join("tensorboard");
        match fs::remove_dir_all(&events_root) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::new(&events_root, "remove the old", e));
            }
            _ => {}
        }
        let mut metrics = Self { path, lines: BufWriter::new(file), events_root, events: Vec::new() };
        for (_, line) in kept {
            metrics.scalars(&line)?;
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
        self.write(&Line::new(stage, step, member, values))
    }

    /// Records a line.
    pub fn write(&mut self, line: &Line) -> Result<(), FileError> {
        let failed = |e| FileError::new(&self.path, "write", e);
        writeln!(self.lines, "{}", line.text()).and_then(|()| self.lines.flush()).map_err(failed)?;
        self.scalars(line)
    }

    fn scalars(&mut self, line: &Line) -> Result<(), FileError> {
        while self.events.len() <= line.member {
            let directory = self.events_root.join(format!("member-{}", self.events.len()));
            self.events.push(Events::create(&directory)?);
        }
        // What is not finite is no number in JSON.
        let value = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
        let values = line.values.iter().map(|(name, v)| (format!("{}/{name}", line.stage), value(v)));
        self.events[line.member].scalars(line.step, values)
    }
}

/// The values named `metric` of `member` in the stage `stage` of a `metrics.jsonl`, by step; nothing where there is no such file.
///
/// # Errors
/// If the file cannot be read.
pub fn recorded(path: &Path, stage: &str, member: usize, metric: &str) -> Result<BTreeMap<u64, f64>, FileError> {
    let text = read_if_there(path)?.unwrap_or_default();
    let text = String::from_utf8_lossy(&text);
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Line>(line).ok());
    let own = lines.filter(|line| line.stage == stage && line.member == member);
    Ok(own.filter_map(|line| Some((line.step, line.values.get(metric)?.as_f64()?))).collect())
}

/// One line of `metrics.jsonl`.
#[derive(Serialize, Deserialize)]
pub struct Line {
    stage: String,
    step: u64,
    member: usize,
    #[serde(flatten)]
    values: Map<String, Value>,
}

impl Line {
    /// `values` of `member` of the population after `step` steps of `stage`.
    pub fn new<'a>(stage: &str, step: u64, member: usize, values: impl IntoIterator<Item = (&'a str, f64)>) -> Self {
        let values = values.into_iter().map(|(name, value)| (name.to_owned(), Value::from(value))).collect();
        Self { stage: stage.into(), step, member, values }
    }

    fn text(&self) -> String {
        serde_json::to_value(self).expect("plain data").to_string()
    }
}

/// A TensorBoard event file: TFRecord frames around `Event` protocol buffers, of which scalars need five fields.
struct Events {
    path: PathBuf,
    file: File,
}

impl Events {
    fn create(directory: &Path) -> Result<Self, FileError> {
        create_folder(directory)?;
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
    use serde_json::json;

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
    fn what_comes_again_is_cut_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::resume(dir.path(), |_, _| false).unwrap();
        for step in [10, 20, 30] {
            metrics.log("learn", step, 0, [("loss", if step == 10 { f64::NAN } else { 0.1 })]).unwrap();
        }
        drop(metrics);
        let path = dir.path().join("metrics.jsonl");
        let undisturbed = fs::read(&path).unwrap();
        fs::write(&path, [&undisturbed[..], b"{\"stage\":\"le"].concat()).unwrap();
        let mut metrics = Metrics::resume(dir.path(), |stage, step| stage == "learn" && step <= 10).unwrap();
        for step in [20, 30] {
            metrics.log("learn", step, 0, [("loss", 0.1)]).unwrap();
        }
        assert_eq!(fs::read(&path).unwrap(), undisturbed);
    }

    #[test]
    fn lines_are_json_and_events_are_written() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::resume(dir.path(), |_, _| false).unwrap();
        metrics.log("learn", 10, 1, [("loss", 0.5), ("score", 61.7)]).unwrap();
        let text = fs::read_to_string(dir.path().join("metrics.jsonl")).unwrap();
        let line: Value = serde_json::from_str(text.trim()).unwrap();
        assert_eq!(line, json!({"stage": "learn", "step": 10, "member": 1, "loss": 0.5, "score": 61.7}));
        let events = fs::read_dir(dir.path().join("tensorboard/member-1")).unwrap().next().unwrap().unwrap();
        let bytes = fs::read(events.path()).unwrap();
        assert!(bytes.windows(10).any(|w| w == b"learn/loss"));
    }
}

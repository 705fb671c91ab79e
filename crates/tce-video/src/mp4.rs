//! MP4 (H.264), by the program `ffmpeg` where there is one: it gets plain pixels through a pipe.

use std::io::{self, BufWriter, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use tce_base::{FileError, Interrupted, Progress, interrupted};
use tce_sim::video::Video;

use crate::error::{Error, Result};

const WHAT_TO_DO: &str = "install it (`apt install ffmpeg`), or name a file that ends in .gif";

/// An `ffmpeg` that has H.264.
pub struct Ffmpeg(());

impl Ffmpeg {
    /// Looks for it in PATH; `video` is the file that it is wanted for.
    pub fn find(video: &Path) -> Result<Self> {
        let encoders = Command::new("ffmpeg").args(["-hide_banner", "-encoders"]).stdin(Stdio::null()).output();
        let encoders = match encoders {
            Ok(output) => output.stdout,
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                let what = format!("an .mp4 needs the program `ffmpeg`, which is not in PATH; {WHAT_TO_DO}");
                return Err(Error::missing(video, what));
            }
            Err(e) => {
                let what = format!("an .mp4 needs the program `ffmpeg`, which cannot be run: {e}; {WHAT_TO_DO}");
                return Err(Error::missing(video, what));
            }
        };
        if !String::from_utf8_lossy(&encoders).contains("libx264") {
            let what = "an .mp4 needs an `ffmpeg` with the encoder libx264, which the one in PATH lacks";
            return Err(Error::missing(video, format!("{what}; {WHAT_TO_DO}")));
        }
        Ok(Self(()))
    }

    /// Lets it encode `video` into the file `at`; `path` is the name that errors tell.
    pub fn write(&self, video: &Video, at: &Path, path: &Path, progress: &Progress) -> Result<()> {
        let [width, height] = video.size();
        let microseconds = (video.interval() * 1e6).round();
        let mut command = Command::new("ffmpeg");
        command.args(["-hide_banner", "-loglevel", "error", "-nostdin", "-y"]);
        command.args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", &format!("{width}x{height}")]);
        command.args(["-framerate", &format!("1000000/{microseconds}"), "-i", "pipe:0"]);
        // One thread, no dates and no versions: the same video has the same bytes, by the same ffmpeg.
        command.args(["-c:v", "libx264", "-preset", "medium", "-crf", "20", "-pix_fmt", "yuv420p", "-threads", "1"]);
        command.args(["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]);
        command.args(["-movflags", "+faststart", "-f", "mp4"]).arg(at);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| FileError::new(path, "start ffmpeg for", e))?;
        let mut pipe = BufWriter::new(child.stdin.take().expect("it is piped"));
        let mut complaints = child.stderr.take().expect("it is piped");
        // Read beside the work: a full pipe would stop both.
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            let _ = complaints.read_to_string(&mut text);
            text
        });
        let mut broken = None;
        let drawn = super::draw(video, progress, |pictures| {
            for picture in pictures {
                if let Err(e) = pipe.write_all(picture.pixels.as_flattened()) {
                    broken = Some(e);
                    // What matters is why ffmpeg went, which it says itself.
                    return Err(Error::Failed(String::new()));
                }
            }
            Ok(())
        });
        let flushed = pipe.flush();
        drop(pipe);
        if drawn.is_err() && broken.is_none() {
            let _ = child.kill();
        }
        let status = child.wait().map_err(|e| FileError::new(path, "wait for ffmpeg for", e))?;
        let complaints = reader.join().unwrap_or_default();
        if interrupted() && !status.success() {
            // Ctrl-C reaches ffmpeg as well, which may have gone first.
            return Err(Interrupted::nothing_kept().into());
        }
        if !status.success() {
            let why = complaints.trim();
            return Err(Error::Failed(format!("{}: ffmpeg failed ({status}): {why}", path.display())));
        }
        if let Some(e) = broken.or(flushed.err()) {
            return Err(FileError::new(path, "hand pictures to ffmpeg for", e).into());
        }
        drawn
    }
}

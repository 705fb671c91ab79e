//! Videos as files: pictures from `tce-sim` are drawn on all cores and encoded in order.
//!
//! ```
//! // The ending of the file decides what is written.
//! assert!(tce_video::parse_video("fall.gif").is_ok() && tce_video::parse_video("fall.mp4").is_ok());
//! assert!(tce_video::parse_video("fall.txt").is_err());
//! assert_eq!(tce_video::parse_size("640x480"), Ok([640, 480]));
//! ```

mod error;
mod gif;
mod mp4;

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use tce_base::{AtomicFile, FileError, Interrupted, Progress, interrupted};
use tce_sim::video::{Picture, Video};

pub use error::{Error, Result};

/// Pictures that are drawn at once. The video does not depend on it.
const BATCH: usize = 16;

/// The kinds of file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Gif,
    Mp4,
}

/// A video's file, named on the command line: the ending decides what is written.
#[derive(Clone, Debug, PartialEq)]
pub struct VideoFile {
    path: PathBuf,
    format: Format,
}

/// Reads `video.gif` and `video.mp4`, and refuses everything else.
pub fn parse_video(text: &str) -> Result<VideoFile, String> {
    let path = PathBuf::from(text);
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let format = match ending.as_deref() {
        Some("gif") => Format::Gif,
        Some("mp4") => Format::Mp4,
        Some(other) => return Err(format!("found the ending `.{other}`, expected .gif or .mp4")),
        None => return Err("found no ending, expected a name that ends in .gif or .mp4".to_owned()),
    };
    Ok(VideoFile { path, format })
}

/// Reads the size of a panel, `480x360`. H.264 takes even numbers only; labels need 320 columns.
pub fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let expected = "expected WIDTHxHEIGHT, even numbers from 320x240 to 1920x1080, as in 480x360";
    let numbers = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    let [width, height]: [usize; 2] = numbers.ok_or(expected)?;
    let fits = (320..=1920).contains(&width) && (240..=1080).contains(&height);
    if fits && width % 2 == 0 && height % 2 == 0 { Ok([width, height]) } else { Err(expected.to_owned()) }
}

/// A video's file that can be written, as far as one can know before the video is there.
pub struct VideoWriter {
    file: AtomicFile,
    path: PathBuf,
    encoder: Encoder,
}

enum Encoder {
    Gif,
    Mp4(mp4::Ffmpeg),
}

impl VideoFile {
    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes sure of everything that the file needs, so that what is missing is said before any work.
    pub fn prepare(self) -> Result<VideoWriter> {
        let encoder = match self.format {
            Format::Gif => Encoder::Gif,
            Format::Mp4 => Encoder::Mp4(mp4::Ffmpeg::find(&self.path)?),
        };
        Ok(VideoWriter { file: AtomicFile::create(&self.path)?, path: self.path, encoder })
    }
}

impl VideoWriter {
    /// Draws and writes the video; how many bytes it has.
    pub fn write(mut self, video: &Video) -> Result<u64> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let progress = Progress::new(format!("draw {name}"), video.frames() as u64, "pictures");
        match &self.encoder {
            Encoder::Gif => gif::write(video, &mut self.file, &self.path, &progress)?,
            Encoder::Mp4(ffmpeg) => ffmpeg.write(video, self.file.path(), &self.path, &progress)?,
        }
        self.file.commit()?;
        progress.finish();
        let bytes = std::fs::metadata(&self.path).map_err(|e| FileError::new(&self.path, "look at", e))?.len();
        Ok(bytes)
    }
}

/// Draws a video batch by batch and hands the pictures over, in order.
fn draw(video: &Video, progress: &Progress, mut take: impl FnMut(Vec<Picture>) -> Result<()>) -> Result<()> {
    for start in (0..video.frames()).step_by(BATCH) {
        if interrupted() {
            return Err(Interrupted::nothing_kept().into());
        }
        let frames = start..(start + BATCH).min(video.frames());
        let count = frames.len() as u64;
        take(frames.into_par_iter().map(|frame| video.draw(frame)).collect())?;
        progress.inc(count);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ending_decides() {
        for (text, format) in [("a.gif", Format::Gif), ("b/c.MP4", Format::Mp4)] {
            assert_eq!(parse_video(text).unwrap(), VideoFile { path: text.into(), format });
        }
        assert!(parse_video("video.webm").unwrap_err().contains("`.webm`"));
        assert!(parse_video("gif").unwrap_err().contains("no ending"));
    }

    #[test]
    fn sizes_are_even_and_of_use() {
        assert_eq!(parse_size("480x360"), Ok([480, 360]));
        for text in ["480", "481x360", "480x-2", "240x180", "4000x1000", "480 x 360"] {
            assert!(parse_size(text).unwrap_err().contains("480x360"), "{text}");
        }
    }
}

//! The video of `tce evaluate --video`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::counted;
use tce_data::{ScoreTable, Shift};
use tce_run::error::{Error, Result};
use tce_sim::video::{Video, VideoOptions};
use tce_sim::{Ending, Recording};
use tce_video::{VideoFile, VideoWriter, parse_size, parse_video};
use tce_zoo::actors::{Arena, Evaluation};

/// Options of the video.
#[derive(Debug, Args)]
pub struct VideoArgs {
    /// Write a video of the first episode, beside the first one in the source domain, to this .gif or .mp4 (which needs ffmpeg).
    #[arg(long, value_name = "FILE", value_parser = parse_video, help_heading = "Video")]
    video: Option<VideoFile>,
    /// The video's longest duration, seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = VideoOptions::default().seconds, requires = "video", help_heading = "Video")]
    video_seconds: f64,
    /// Simulated seconds in one second of the video: 1 is real time.
    #[arg(long, value_name = "FACTOR", default_value_t = VideoOptions::default().speed, requires = "video", help_heading = "Video")]
    video_speed: f64,
    /// Pixels of one panel.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "480x360", value_parser = parse_size, requires = "video", help_heading = "Video")]
    video_size: [usize; 2],
    /// Replace an existing video.
    #[arg(long, requires = "video", help_heading = "Video")]
    force: bool,
}

#[derive(Serialize)]
pub struct VideoReport {
    file: PathBuf,
    bytes: u64,
    width: usize,
    height: usize,
    frames: usize,
    /// Seconds for which a frame is shown.
    interval: f64,
    /// Steps of an episode from one frame to the next.
    stride: usize,
    /// From left to right.
    panels: Vec<Shown>,
}

#[derive(Serialize)]
pub struct Shown {
    environment: String,
    #[serde(rename = "return")]
    episode_return: f64,
    length: usize,
    ending: Ending,
}

/// An error of `tce-video` as one of the command.
fn as_ours(error: tce_video::Error) -> Error {
    match error {
        tce_video::Error::Interrupted(reason) => reason.into(),
        tce_video::Error::File(error) => Error::File(error),
        tce_video::Error::Failed(text) => Error::Failed(text),
        tce_video::Error::Missing { path, what } => Error::Missing { path, what },
    }
}

impl VideoArgs {
    /// What the video needs, if one is asked for; refuses before any work what cannot become one.
    pub fn writer(&self, policies: &[PathBuf]) -> Result<Option<VideoWriter>> {
        let Some(video) = &self.video else { return Ok(None) };
        let path = video.path().display();
        if policies.len() != 1 {
            return Err(Error::Usage(format!(
                "--video {path}: found {} policies, expected one; call the command once for each video",
                policies.len()
            )));
        }
        for (option, value, range) in
            [("--video-seconds", self.video_seconds, 0.1..=600.0), ("--video-speed", self.video_speed, 0.05..=100.0)]
        {
            if !range.contains(&value) {
                let (low, high) = (range.start(), range.end());
                return Err(Error::Usage(format!("{option}: found {value}, expected a number from {low} to {high}")));
            }
        }
        crate::commands::refuse::existing(video.path(), self.force)?;
        video.clone().prepare().map(Some).map_err(as_ours)
    }
}

impl VideoArgs {
    /// Records a video of the first of the episodes that `roll` rolls out in `arena`: so many of them, recorded.
    pub fn record(
        &self,
        writer: VideoWriter,
        arena: Arena,
        roll: impl Fn(Arena, usize) -> Result<(Evaluation, Recording)>,
        episodes: usize,
    ) -> Result<(Evaluation, VideoReport)> {
        let (evaluation, recording) = roll(arena, episodes)?;
        let mut recordings = Vec::new();
        if arena.shift != Shift::Source {
            recordings.push(roll(Arena::new(arena.agent, Shift::Source, ScoreTable::default()), 1)?.1);
        }
        recordings.push(recording);
        let options = VideoOptions { size: self.video_size, seconds: self.video_seconds, speed: self.video_speed };
        let video = Video::new(recordings, options)?;
        let bytes = writer.write(&video).map_err(as_ours)?;
        let file = self.video.as_ref().expect("there is a writer").path().to_owned();
        let [width, height] = video.size();
        let frames = video.frames();
        let longest = video.longest();
        let mut note = format!(
            "{}: {} of {width}x{height}, {:.1} s, {:.1} MB",
            file.display(),
            counted(frames, "frame", "frames"),
            frames as f64 * video.interval(),
            bytes as f64 / 1e6
        );
        if video.steps() < longest {
            note += &format!("; steps 0 to {} of {longest} (see --video-seconds, --video-speed)", video.steps());
        }
        tce_base::note!("{note}");
        let panels = video.recordings().map(Shown::of).collect();
        let (interval, stride) = (video.interval(), video.stride());
        Ok((evaluation, VideoReport { file, bytes, width, height, frames, interval, stride, panels }))
    }
}

impl Shown {
    fn of(recording: &Recording) -> Self {
        let length = recording.length();
        Self {
            environment: format!("{}-{}", recording.agent, recording.shift),
            episode_return: recording.return_at(length),
            length,
            ending: recording.ending,
        }
    }
}

//! `tce evaluate`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::{Streams, interrupted};
use tce_data::{Agent, ScoreTable, Shift, parse_environment};
use tce_learn::Policy;
use tce_sim::film::{Film, FilmOptions};
use tce_sim::{Ending, Recording};

use crate::actors::{Arena, Evaluation, evaluate, evaluate_recorded, load_policy};
use crate::error::{Error, Result};
use crate::output::{Output, mark_best, mean_std, table};
use crate::video::{Studio, VideoFile, parse_size, parse_video};

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub struct Evaluate {
    /// Policies (.safetensors, .npz, or zoo:NAME; see tce zoo list).
    #[arg(required = true)]
    policies: Vec<PathBuf>,
    /// The environment: hopper (source), hopper-morph, ant-gravity, ...
    #[arg(long, value_parser = parse_environment)]
    env: (Agent, Shift),
    /// Episodes.
    #[arg(long, default_value_t = 10)]
    episodes: usize,
    /// Sample actions instead of taking the mean.
    #[arg(long)]
    sample: bool,
    /// Seed of the resets (and of sampled actions).
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Film the first episode, beside the first one in the source domain, into this .gif or .mp4 (which needs ffmpeg).
    #[arg(long, value_name = "FILE", value_parser = parse_video, help_heading = "Film")]
    video: Option<VideoFile>,
    /// The film's longest duration, seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = FilmOptions::default().seconds, requires = "video", help_heading = "Film")]
    video_seconds: f64,
    /// Simulated seconds in one second of the film: 1 is real time.
    #[arg(long, value_name = "FACTOR", default_value_t = FilmOptions::default().speed, requires = "video", help_heading = "Film")]
    video_speed: f64,
    /// Pixels of one panel.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "480x360", value_parser = parse_size, requires = "video", help_heading = "Film")]
    video_size: [usize; 2],
    /// Replace an existing film.
    #[arg(long, requires = "video", help_heading = "Film")]
    force: bool,
}

#[derive(Serialize)]
struct Evaluated {
    policy: PathBuf,
    environment: String,
    #[serde(flatten)]
    evaluation: Evaluation,
    #[serde(skip_serializing_if = "Option::is_none")]
    video: Option<Filmed>,
}

#[derive(Serialize)]
struct Filmed {
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
struct Shown {
    environment: String,
    #[serde(rename = "return")]
    episode_return: f64,
    length: usize,
    ending: Ending,
}

impl Evaluate {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        if self.episodes == 0 {
            return Err(Error::Usage("--episodes must be at least 1".into()));
        }
        tce_sim::open_library()?;
        let (agent, shift) = self.env;
        let arena = Arena::new(agent, shift, ScoreTable::default());
        let studio = self.studio()?;
        let policies: Vec<_> = self.policies.iter().map(|p| load_policy(p, agent)).collect::<Result<_>>()?;
        let mut all = Vec::new();
        if let Some(studio) = studio {
            all.push(self.film(studio, &policies[0], arena)?);
        } else {
            for (path, policy) in self.policies.iter().zip(&policies) {
                let streams = Streams::new(self.seed);
                let evaluation = evaluate(policy, arena, self.episodes, streams, !self.sample, interrupted)?;
                let environment = format!("{agent}-{shift}");
                all.push(Evaluated { policy: path.clone(), environment, evaluation, video: None });
            }
        }
        output.print(&all, |all| {
            let mut rows: Vec<_> = all
                .iter()
                .map(|e| {
                    let (mean, std) = mean_std(&e.evaluation.returns);
                    [
                        e.policy.display().to_string(),
                        e.evaluation.returns.len().to_string(),
                        format!("{mean:.1} ± {std:.1}"),
                        format!("{:.0}", e.evaluation.mean_length()),
                        e.evaluation.score.map_or("-".into(), |s| format!("{s:.1}")),
                    ]
                })
                .collect();
            mark_best(rows.iter_mut().map(|row| &mut row[4]));
            table(&["policy", "episodes", "return", "length", "score"], rows)
        });
        Ok(())
    }

    /// What the film needs, if one is asked for; refuses before any work what cannot become one.
    fn studio(&self) -> Result<Option<Studio>> {
        let Some(video) = &self.video else { return Ok(None) };
        let path = video.path().display();
        if self.policies.len() != 1 {
            return Err(Error::Usage(format!(
                "--video {path}: found {} policies, expected one; call the command once for each film",
                self.policies.len()
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
        super::refuse_existing(video.path(), self.force)?;
        video.clone().prepare().map(Some)
    }

    /// Evaluates the only policy and films it.
    fn film(&self, studio: Studio, policy: &Policy, arena: Arena) -> Result<Evaluated> {
        let roll = |arena, episodes| {
            evaluate_recorded(policy, arena, episodes, Streams::new(self.seed), !self.sample, interrupted)
        };
        let (evaluation, recording) = roll(arena, self.episodes)?;
        let mut recordings = Vec::new();
        if arena.shift != Shift::Source {
            recordings.push(roll(Arena::new(arena.agent, Shift::Source, ScoreTable::default()), 1)?.1);
        }
        recordings.push(recording);
        let options = FilmOptions { size: self.video_size, seconds: self.video_seconds, speed: self.video_speed };
        let film = Film::new(recordings, options)?;
        let bytes = studio.write(&film)?;
        let file = self.video.as_ref().expect("there is a studio").path().to_owned();
        let [width, height] = film.size();
        let frames = film.frames();
        let longest = film.longest();
        let mut note = format!(
            "{}: {frames} frames of {width}x{height}, {:.1} s, {:.1} MB",
            file.display(),
            frames as f64 * film.interval(),
            bytes as f64 / 1e6
        );
        if film.steps() < longest {
            note += &format!("; steps 0 to {} of {longest} (see --video-seconds, --video-speed)", film.steps());
        }
        tce_base::note!("{note}");
        let panels = film.recordings().map(Shown::of).collect();
        let (interval, stride) = (film.interval(), film.stride());
        let video = Some(Filmed { file, bytes, width, height, frames, interval, stride, panels });
        let policy = self.policies[0].clone();
        Ok(Evaluated { policy, environment: format!("{}-{}", arena.agent, arena.shift), evaluation, video })
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

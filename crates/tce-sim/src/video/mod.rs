//! Videos of recorded episodes, side by side. All drawing is done here on the CPU, from the coordinates: without OpenGL
//! and without a screen. The same recordings give the same pixels.

mod camera;
mod picture;
mod scene;
mod solid;
mod text;

use tce_data::{ReferenceScores, ScoreTable, Shift, reference_scores};

use crate::SimError;
use crate::env::seconds_per_step;
use crate::models::robot::Vec3;
use crate::models::{compiled, difference};
use crate::recording::{Ending, Recording};

use camera::{Camera, View};
use picture::mix;
use solid::{Body, Paint, Solid};
use text::Style;

pub use picture::{Colour, Picture};

/// Approximate duration of a picture in seconds: 25 pictures per second.
const INTERVAL: f64 = 0.04;
/// Duration of the last picture in seconds, so that it can be read before the video restarts.
const HOLD: f64 = 1.0;
/// Pixels between two panels.
const GAP: usize = 2;

const INK: Colour = [38, 44, 56];
const FAINT: Colour = [92, 100, 114];
const ALARM: Colour = [196, 40, 40];

/// Options of a video.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VideoOptions {
    /// Width and height of a panel, pixels.
    pub size: [usize; 2],
    /// Longest duration, s.
    pub seconds: f64,
    /// Simulated seconds in one second of the video.
    pub speed: f64,
}

impl Default for VideoOptions {
    fn default() -> Self {
        Self { size: [480, 360], seconds: 10.0, speed: 1.0 }
    }
}

/// A video whose pictures can be drawn one by one, in any order.
pub struct Video {
    panels: Vec<Panel>,
    size: [usize; 2],
    frames: usize,
    stride: usize,
    interval: f64,
}

struct Panel {
    recording: Recording,
    reference: Option<ReferenceScores>,
    /// Torso and parts in every picture up to the end of the episode.
    poses: Vec<(Vec3, Vec<Solid>)>,
    /// The changes made by the shift; empty if there are none.
    legend: Vec<String>,
}

impl Video {
    /// A video of one robot's episodes, arranged from left to right. It ends a second after the longest of them, or
    /// after [`VideoOptions::seconds`].
    ///
    /// # Errors
    /// If a model cannot be compiled (the recording has already compiled it).
    ///
    /// # Panics
    /// If there are no recordings.
    pub fn new(recordings: Vec<Recording>, options: VideoOptions) -> Result<Self, SimError> {
        let first = &recordings[0];
        let dt = seconds_per_step(first.agent, &*compiled(first.agent, first.shift)?);
        let stride = ((options.speed * INTERVAL / dt).round() as usize).max(1);
        let interval = stride as f64 * dt / options.speed;
        let longest = recordings.iter().map(Recording::length).max().expect("a recording");
        let whole = longest.div_ceil(stride) + 1 + (HOLD / interval).round() as usize;
        let frames = whole.min(((options.seconds / interval + 1e-9) as usize).max(1));
        let panels = recordings.into_iter().map(|r| Panel::new(r, frames, stride)).collect::<Result<_, _>>()?;
        Ok(Self { panels, size: options.size, frames, stride, interval })
    }

    /// Number of pictures.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Duration of a picture in seconds.
    pub fn interval(&self) -> f64 {
        self.interval
    }

    /// Number of episode steps between two pictures.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The episodes, from left to right.
    pub fn recordings(&self) -> impl Iterator<Item = &Recording> {
        self.panels.iter().map(|panel| &panel.recording)
    }

    /// Number of steps of the longest episode.
    pub fn longest(&self) -> usize {
        self.recordings().map(Recording::length).max().expect("a recording")
    }

    /// Number of steps of the longest episode that are shown.
    pub fn steps(&self) -> usize {
        self.longest().min((self.frames - 1) * self.stride)
    }

    /// Width and height of a picture, pixels.
    pub fn size(&self) -> [usize; 2] {
        let panels = self.panels.len();
        [panels * self.size[0] + (panels - 1) * GAP, self.size[1]]
    }

    /// Draws picture number `frame`, counted from 0.
    pub fn draw(&self, frame: usize) -> Picture {
        let [width, height] = self.size();
        let mut picture = Picture::new(width, height, [255; 3]);
        for (k, panel) in self.panels.iter().enumerate() {
            picture.paste(&panel.draw(frame, self.stride, self.size), k * (self.size[0] + GAP));
        }
        picture
    }
}

impl Panel {
    fn new(recording: Recording, frames: usize, stride: usize) -> Result<Self, SimError> {
        let (agent, shift) = (recording.agent, recording.shift);
        let mut body = Body::new(agent, shift)?;
        let shown = frames.min(recording.length().div_ceil(stride) + 1);
        let poses = (0..shown).map(|f| body.pose(recording.pose((f * stride).min(recording.length())))).collect();
        let reference = reference_scores(agent, shift, ScoreTable::default());
        let difference = difference(agent, shift);
        let mut legend = Vec::new();
        if !difference.reshaped.is_empty() {
            legend.push(format!("other shape: {}", difference.reshaped.join(", ")));
        }
        if !difference.restricted.is_empty() {
            legend.push(format!("smaller range: {}", difference.restricted.join(", ")));
        }
        if difference.gravity != 1.0 {
            legend.push(format!("gravity × {}", difference.gravity));
        }
        Ok(Self { recording, reference, poses, legend })
    }

    fn draw(&self, frame: usize, stride: usize, size: [usize; 2]) -> Picture {
        let recording = &self.recording;
        let step = (frame * stride).min(recording.length());
        let (torso, solids) = &self.poses[frame.min(self.poses.len() - 1)];
        let camera = Camera::following(recording.agent, *torso, size);
        let mut picture = scene::draw(&camera, solids, View::of(recording.agent).floor, size);
        let (regular, bold) = (|colour| Style::regular(size[1], colour), |colour| Style::bold(size[1], colour));
        let (line, margin) = (regular(INK).line(), regular(INK).advance());
        let shift = recording.shift;
        let name =
            if shift == Shift::Source { recording.agent.to_string() } else { format!("{}-{shift}", recording.agent) };
        text::write(&mut picture, margin, line / 2, &name, bold(INK));
        let so_far = recording.return_at(step);
        let mut status = format!("step {step:>4}  return {so_far:>7.1}");
        if let Some(reference) = self.reference {
            status += &format!("  score {:>5.1}", reference.normalised_score(so_far));
        }
        text::write(&mut picture, margin, line / 2 + line, &status, regular(FAINT));
        if step == recording.length() {
            let (mark, colour) = match recording.ending {
                Ending::Fell => (format!("fell at step {step}"), ALARM),
                Ending::TimeLimit => (format!("time limit, step {step}"), FAINT),
                Ending::Unstable => (format!("simulation blew up after step {step}"), ALARM),
            };
            text::write(&mut picture, margin, line / 2 + 2 * line, &mark, bold(colour));
        }
        let accent = scene::colour(Paint::Changed);
        for (k, entry) in self.legend.iter().rev().enumerate() {
            let top = (size[1] - line / 2).saturating_sub((k + 1) * line);
            picture.fill([margin, top + 4], [line - 10, line - 10], accent);
            text::write(&mut picture, margin + line, top, entry, regular(mix(accent, INK, 0.6)));
        }
        picture
    }
}

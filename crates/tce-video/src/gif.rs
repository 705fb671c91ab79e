//! GIF: one palette for the whole video, and of every picture only what changed.

use std::collections::HashMap;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use gif::{DisposalMethod, Encoder, EncodingError, Frame, Repeat};
use rayon::prelude::*;
use tce_base::{AtomicFile, FileError, Progress};
use tce_sim::video::{Colour, Picture, Video};

use crate::error::Result;

/// Pictures that the palette is made from, evenly spread.
const LOOKED_AT: usize = 24;
/// The colour that leaves a pixel as it is. The others are those before it.
const KEEP: u8 = 255;

/// Writes `video` as an endless loop; `path` is the name that errors tell.
pub fn write(video: &Video, file: &mut AtomicFile, path: &Path, progress: &Progress) -> Result<()> {
    let failed = |e: EncodingError| {
        let e = match e {
            EncodingError::Io(e) => e,
            other => io::Error::other(other.to_string()),
        };
        FileError::new(path, "write", e)
    };
    let last = video.frames() - 1;
    let looked_at: Vec<usize> = (0..LOOKED_AT).map(|k| k * last / (LOOKED_AT - 1)).collect();
    let palette = Palette::of(&looked_at.par_iter().map(|&frame| video.draw(frame)).collect::<Vec<_>>());
    let [width, height] = video.size();
    let mut encoder =
        Encoder::new(BufWriter::new(file.file()), width as u16, height as u16, &palette.bytes()).map_err(failed)?;
    encoder.set_repeat(Repeat::Infinite).map_err(failed)?;
    let mut before: Vec<u8> = Vec::new();
    let mut number = 0;
    super::draw(video, progress, |pictures| {
        let indexed: Vec<Vec<u8>> = pictures.par_iter().map(|picture| palette.indices(picture)).collect();
        let frames: Vec<Frame<'static>> = (0..indexed.len())
            .into_par_iter()
            .map(|k| {
                let before = if k == 0 { &before } else { &indexed[k - 1] };
                let mut frame = changes(before, &indexed[k], width);
                frame.delay = delay(video.interval(), number + k);
                frame.make_lzw_pre_encoded();
                frame
            })
            .collect();
        for frame in &frames {
            encoder.write_lzw_pre_encoded_frame(frame).map_err(failed)?;
        }
        number += frames.len();
        before = indexed.into_iter().next_back().expect("a batch is not empty");
        Ok(())
    })?;
    let mut writer = encoder.into_inner().map_err(failed)?;
    writer.flush().map_err(|e| FileError::new(path, "write", e))?;
    Ok(())
}

/// Hundredths of a second for which picture `number` stays. Rounded so that the video as a whole keeps time.
fn delay(interval: f64, number: usize) -> u16 {
    let until = |n: usize| (100.0 * interval * n as f64).round();
    (until(number + 1) - until(number)) as u16
}

/// The smallest rectangle that holds what differs from the picture before, which is empty before the first.
fn changes(before: &[u8], now: &[u8], width: usize) -> Frame<'static> {
    let differs = |at: usize| before.get(at) != Some(&now[at]);
    let height = now.len() / width;
    let row = |y: usize| (0..width).any(|x| differs(y * width + x));
    let column = |x: usize| (0..height).any(|y| differs(y * width + x));
    // Where nothing does, a pixel is written again: a frame cannot be empty.
    let top = (0..height).find(|&y| row(y)).unwrap_or(0);
    let bottom = (0..height).rfind(|&y| row(y)).unwrap_or(0);
    let left = (0..width).find(|&x| column(x)).unwrap_or(0);
    let right = (0..width).rfind(|&x| column(x)).unwrap_or(0);
    let pixels = (top..=bottom).flat_map(|y| (left..=right).map(move |x| y * width + x));
    Frame {
        left: left as u16,
        top: top as u16,
        width: (right - left + 1) as u16,
        height: (bottom - top + 1) as u16,
        dispose: DisposalMethod::Keep,
        transparent: Some(KEEP),
        buffer: pixels.map(|at| if differs(at) { now[at] } else { KEEP }).collect(),
        ..Frame::default()
    }
}

/// Up to 255 colours.
struct Palette {
    colours: Vec<Colour>,
}

impl Palette {
    /// The most frequent colours of some pictures. A video of flat areas has few that matter: the rest are mixtures at edges, which
    /// a neighbour replaces unseen.
    fn of(pictures: &[Picture]) -> Self {
        let mut counts: HashMap<Colour, u64> = HashMap::new();
        for picture in pictures {
            for run in picture.pixels.chunk_by(|a, b| a == b) {
                *counts.entry(run[0]).or_default() += run.len() as u64;
            }
        }
        let mut all: Vec<_> = counts.into_iter().collect();
        // By the colour, too: a hash map has no order of its own.
        all.sort_unstable_by_key(|&(colour, count)| (std::cmp::Reverse(count), colour));
        let colours = all.into_iter().take(usize::from(KEEP)).map(|(colour, _)| colour).collect();
        Self { colours }
    }

    /// As GIF wants it, with a colour for [`KEEP`] that is never seen.
    fn bytes(&self) -> Vec<u8> {
        let mut bytes = self.colours.concat();
        bytes.resize(3 * 256, 0);
        bytes
    }

    /// Every pixel's nearest colour.
    fn indices(&self, picture: &Picture) -> Vec<u8> {
        let mut known: HashMap<Colour, u8> = self.colours.iter().zip(0..).map(|(&c, k)| (c, k)).collect();
        let mut out = Vec::with_capacity(picture.pixels.len());
        for run in picture.pixels.chunk_by(|a, b| a == b) {
            let index = *known.entry(run[0]).or_insert_with(|| self.nearest(run[0]));
            out.resize(out.len() + run.len(), index);
        }
        out
    }

    fn nearest(&self, colour: Colour) -> u8 {
        let distance = |c: &Colour| (0..3).map(|i| (i32::from(c[i]) - i32::from(colour[i])).pow(2)).sum::<i32>();
        let nearest = self.colours.iter().enumerate().min_by_key(|(_, c)| distance(c));
        nearest.expect("a picture has a colour").0 as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_keep_time() {
        assert_eq!((0..4).map(|k| delay(0.04, k)).collect::<Vec<_>>(), [4, 4, 4, 4]);
        let thirds: Vec<u16> = (0..300).map(|k| delay(1.0 / 30.0, k)).collect();
        assert_eq!(thirds.iter().map(|&d| u64::from(d)).sum::<u64>(), 1000);
        assert!(thirds.iter().all(|d| (3..=4).contains(d)));
    }

    #[test]
    fn only_changes_are_kept() {
        let before = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1];
        let now = [1, 1, 1, 1, 1, 2, 1, 3, 1, 1, 4, 1];
        let frame = changes(&before, &now, 4);
        assert_eq!((frame.left, frame.top, frame.width, frame.height), (1, 1, 3, 2));
        assert_eq!(*frame.buffer, [2, KEEP, 3, KEEP, 4, KEEP]);
        let same = changes(&now, &now, 4);
        assert_eq!((same.width, same.height, &*same.buffer), (1, 1, &[KEEP][..]));
        assert_eq!(*changes(&[], &now, 4).buffer, now);
    }

    #[test]
    fn frequent_colours_stay_and_rare_ones_go_to_their_neighbour() {
        let mut picture = Picture::new(600, 2, [0; 3]);
        for x in 0..600 {
            // Row 1: 254 colours, at least two pixels each; and at last one that is rare.
            picture.pixels[600 + x] = [(x % 254) as u8 + 1, 200, 0];
        }
        picture.pixels[0] = [254, 198, 0];
        let palette = Palette::of(&[picture.clone()]);
        assert_eq!(palette.colours.len(), 255);
        let indices = palette.indices(&picture);
        assert_eq!(palette.colours[usize::from(indices[1])], [0; 3]);
        assert_eq!(palette.colours[usize::from(indices[600])], [1, 200, 0]);
        assert_eq!(palette.colours[usize::from(indices[0])], [254, 200, 0]);
        assert!(!indices.contains(&KEEP));
    }
}

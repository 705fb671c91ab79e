//! Tests of videos: the evaluated episode, the same pixels every time, and details that a viewer must distinguish.

use rayon::prelude::*;
use tce_base::Streams;
use tce_data::{Agent, Shift};
use tce_sim::video::{Colour, Picture, Video, VideoOptions};
use tce_sim::{EPISODE_LIMIT, Ending, Recording, UniformActor, evaluate, evaluate_recorded};

const SIZE: [usize; 2] = [240, 180];

fn record(agent: Agent, shift: Shift, seed: u64) -> Recording {
    evaluate_recorded(agent, shift, &UniformActor, 1, Streams::new(seed), || false).unwrap().1
}

fn video(recordings: Vec<Recording>) -> Video {
    Video::new(recordings, VideoOptions { size: SIZE, ..VideoOptions::default() }).unwrap()
}

/// The pixels of one panel.
fn panel(picture: &Picture, number: usize) -> Vec<Colour> {
    let start = number * (SIZE[0] + 2);
    picture.pixels.chunks_exact(picture.width).flat_map(|row| row[start..start + SIZE[0]].to_vec()).collect()
}

/// Number of pixels in the hue of the accent colour (vermilion), at any brightness.
fn accents(pixels: &[Colour]) -> usize {
    let orange = |p: &&Colour| {
        let [r, g, b] = p.map(f64::from);
        r > 1.5 * g && g > 1.3 * b
    };
    pixels.iter().filter(orange).count()
}

#[test]
fn watching_changes_nothing() {
    for agent in Agent::ALL {
        let streams = Streams::new(5);
        let blind = evaluate(agent, Shift::Morph, &UniformActor, 3, streams, || false).unwrap();
        let (results, recording) = evaluate_recorded(agent, Shift::Morph, &UniformActor, 3, streams, || false).unwrap();
        assert_eq!(results, blind);
        let length = recording.length();
        assert_eq!(recording.return_at(length), results[0].episode_return);
        assert_eq!((recording.return_at(0), length), (0.0, results[0].length));
        assert_eq!(recording.ending, if length == EPISODE_LIMIT { Ending::TimeLimit } else { Ending::Fell });
    }
    let none = evaluate_recorded(Agent::Hopper, Shift::Source, &UniformActor, 0, Streams::new(1), || false);
    assert!(none.unwrap_err().to_string().contains("episodes"));
}

#[test]
fn time_runs_as_it_does_in_the_simulator() {
    let hopper = record(Agent::Hopper, Shift::Source, 1);
    let length = hopper.length();
    assert!(length < 200, "random hopping ends soon");
    // 8 ms per step: every fifth step gives 25 pictures per second; 25 more for the last second.
    let real = video(vec![hopper.clone()]);
    assert_eq!((real.stride(), real.frames(), real.size()), (5, length.div_ceil(5) + 1 + 25, SIZE));
    assert!((real.interval() - 0.04).abs() < 1e-12);
    assert_eq!(real.steps(), length);
    let with = |seconds, speed| Video::new(vec![hopper.clone()], VideoOptions { size: SIZE, seconds, speed }).unwrap();
    // A fifth of the speed: every step is shown, and there is time for only five pictures.
    let slow = with(0.2, 0.2);
    assert_eq!((slow.stride(), slow.frames(), slow.steps()), (1, 5, 4));
    assert_eq!(with(10.0, 4.0).stride(), 20);
    // HalfCheetah and Ant have 50 ms per step: every step is a picture.
    let ant = video(vec![record(Agent::Ant, Shift::Source, 1)]);
    assert_eq!((ant.stride(), ant.frames().min(200)), (1, ant.frames()));
    assert!((ant.interval() - 0.05).abs() < 1e-12);
}

#[test]
fn the_same_pixels_in_any_order_at_any_number_of_threads() {
    let make = || video(vec![record(Agent::Walker2d, Shift::Source, 3), record(Agent::Walker2d, Shift::Morph, 3)]);
    let (one, other) = (make(), make());
    let forwards: Vec<Picture> = (0..one.frames()).map(|k| one.draw(k)).collect();
    let parallel: Vec<Picture> = (0..other.frames()).into_par_iter().map(|k| other.draw(k)).collect();
    assert!(forwards == parallel);
    assert!(forwards[0] != forwards[2], "it moves");
    assert_eq!([forwards[0].width, forwards[0].height], [2 * SIZE[0] + 2, SIZE[1]]);
}

#[test]
fn an_episode_that_is_over_stays_on_its_last_picture() {
    // The shortest and the longest of a few episodes.
    let mut some: Vec<Recording> = (0..12).map(|seed| record(Agent::Hopper, Shift::Source, seed)).collect();
    some.sort_by_key(Recording::length);
    let (short, long) = (some.swap_remove(0), some.pop().unwrap());
    let end = short.length().div_ceil(5);
    let video = video(vec![short, long]);
    let last = video.frames() - 1;
    assert!(end + 1 < last - 25, "they differ by some pictures");
    let [running, over, late, finis] = [end - 1, end, end + 1, last].map(|k| video.draw(k));
    assert!(panel(&running, 0) != panel(&over, 0));
    assert!(panel(&over, 0) == panel(&late, 0) && panel(&over, 0) == panel(&finis, 0));
    assert!(panel(&over, 1) != panel(&late, 1), "the other goes on");
}

#[test]
fn the_accent_is_seen_in_the_changed_robot_only() {
    for (agent, shift, body) in [
        (Agent::Hopper, Shift::Morph, true),
        (Agent::HalfCheetah, Shift::Kinematic, true),
        (Agent::Walker2d, Shift::Gravity, false),
    ] {
        let first = video(vec![record(agent, Shift::Source, 4), record(agent, shift, 4)]).draw(0);
        assert_eq!(accents(&panel(&first, 0)), 0, "{agent}");
        let changed = panel(&first, 1);
        // The legend is in the lowest rows; another gravity is shown only there.
        let above = accents(&changed[..150 * SIZE[0]]);
        assert!(accents(&changed[150 * SIZE[0]..]) > 40, "{agent}-{shift}: a legend");
        assert_eq!(above > 30, body, "{agent}-{shift}: {above} pixels");
        assert!(body || above == 0);
    }
}

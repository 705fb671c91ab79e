//! `tce evaluate --video`, through the real binary.

#![cfg(feature = "video")]

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::common::{files, message, program, silent, tce, tce_json};

const POLICY: &str = "zoo:hopper-source-expert";
const SMALL: [&str; 2] = ["--video-size", "320x240"];

/// Size, number of frames, delays in hundredths of a second, whether it repeats for ever, and every frame as it is seen.
struct Decoded {
    size: [u16; 2],
    delays: Vec<u16>,
    endless: bool,
    pictures: Vec<Vec<u8>>,
}

fn decode(path: &Path) -> Decoded {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(fs::File::open(path).unwrap()).unwrap();
    let size = [decoder.width(), decoder.height()];
    let mut out = Decoded { size, delays: Vec::new(), endless: false, pictures: Vec::new() };
    let mut canvas = vec![0; 4 * usize::from(size[0]) * usize::from(size[1])];
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        out.delays.push(frame.delay);
        let width = usize::from(frame.width);
        for (k, pixel) in frame.buffer.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
            let (x, y) = (usize::from(frame.left) + k % width, usize::from(frame.top) + k / width);
            let at = 4 * (y * usize::from(size[0]) + x);
            canvas[at..at + 4].copy_from_slice(pixel);
        }
        out.pictures.push(canvas.clone());
    }
    out.endless = decoder.repeat() == gif::Repeat::Infinite;
    out
}

fn video(dir: &Path, env: &str, out: &str, more: &[&str]) -> serde_json::Value {
    let args = ["evaluate", POLICY, "--env", env, "--episodes", "2", "--seed", "3", "--video", out];
    tce_json(dir, &[&args[..], &SMALL, more].concat())
}

#[test]
fn a_video_shows_the_episodes_that_the_table_counts() {
    let dir = tempfile::tempdir().unwrap();
    let report = video(dir.path(), "hopper-morph", "video.gif", &["--video-seconds", "2"]);
    let (shown, returns) = (&report[0]["video"], &report[0]["returns"]);
    let names: Vec<_> = shown["panels"].as_array().unwrap().iter().map(|p| p["environment"].clone()).collect();
    assert_eq!(names, ["hopper-source", "hopper-morph"]);
    assert_eq!(shown["panels"][1]["return"], returns[0]);
    assert_eq!(shown["panels"][1]["ending"], "fell");
    let args = ["evaluate", POLICY, "--env", "hopper", "--episodes", "2", "--seed", "3"];
    let source = tce_json(dir.path(), &args);
    assert_eq!(shown["panels"][0]["return"], source[0]["returns"][0]);
    assert!(source[0].get("video").is_none());
    let plain = tce_json(dir.path(), &["evaluate", POLICY, "--env", "hopper-morph", "--episodes", "2", "--seed", "3"]);
    assert_eq!(&plain[0]["returns"], returns, "a video changes nothing");

    // 2 s of 25 pictures.
    let decoded = decode(&dir.path().join("video.gif"));
    assert_eq!((decoded.size, decoded.pictures.len(), decoded.endless), ([642, 240], 50, true));
    assert!(decoded.delays.iter().all(|&delay| delay == 4), "{:?}", decoded.delays);
    assert!((1..50).all(|k| decoded.pictures[k] != decoded.pictures[k - 1]), "something moves in every picture");
    assert_eq!(shown["frames"], 50);
    assert_eq!(shown["bytes"], fs::metadata(dir.path().join("video.gif")).unwrap().len());
    assert_eq!(files(dir.path()).len(), 1, "nothing is left beside it");
}

#[test]
fn the_same_bytes_at_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let short = ["--video-seconds", "1", "--threads"];
    let bytes = |out: &str, threads: &str| {
        video(dir.path(), "hopper", out, &[&short[..], &[threads]].concat());
        fs::read(dir.path().join(out)).unwrap()
    };
    let one = bytes("one.gif", "1");
    assert!(one == bytes("three.gif", "3"));
    // Without a shift there is nothing to compare with: one panel.
    assert_eq!(decode(&dir.path().join("one.gif")).size, [320, 240]);
    let other = video(dir.path(), "hopper", "other.gif", &["--video-seconds", "1", "--sample"]);
    assert_eq!(other[0]["video"]["panels"].as_array().unwrap().len(), 1);
    assert!(one != fs::read(dir.path().join("other.gif")).unwrap());
}

#[test]
fn what_cannot_become_a_video_is_refused_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |args: &[&str], code: i32, words: &[&str]| {
        let path = dir.path().join("nothing");
        let args = [&["evaluate", "--env", "hopper-morph"], args].concat();
        let output = program(dir.path(), &args).env("PATH", path).output().unwrap();
        let message = message(&output);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {message}");
        for word in words {
            assert!(message.contains(word), "{args:?}: no `{word}` in: {message}");
        }
        assert!(!message.contains("draw"), "{message}");
    };
    refused(&[POLICY, "--video", "video.webm"], 2, &["video.webm", "`.webm`", ".gif or .mp4"]);
    refused(&[POLICY, "--video", "video"], 2, &["video", "no ending", ".gif or .mp4"]);
    refused(&[POLICY, POLICY, "--video", "video.gif"], 2, &["video.gif", "2 policies", "expected one"]);
    refused(&[POLICY, "--video", "video.mp4"], 1, &["video.mp4", "ffmpeg", "PATH", "apt install ffmpeg", ".gif"]);
    refused(&[POLICY, "--video", "f.gif", "--video-seconds", "0"], 2, &["--video-seconds", "found 0", "0.1"]);
    refused(&[POLICY, "--video", "f.gif", "--video-speed", "NaN"], 2, &["--video-speed", "NaN"]);
    refused(&[POLICY, "--video", "f.gif", "--video-size", "481x360"], 2, &["481x360", "even"]);
    refused(&[POLICY, "--video-seconds", "3"], 2, &["--video"]);
    assert_eq!(files(dir.path()), Vec::<PathBuf>::new());
    fs::write(dir.path().join("mine.gif"), b"precious").unwrap();
    refused(&[POLICY, "--video", "mine.gif"], 2, &["mine.gif", "exists", "--force"]);
    assert_eq!(fs::read(dir.path().join("mine.gif")).unwrap(), b"precious");
    video(dir.path(), "hopper", "mine.gif", &["--force", "--video-seconds", "0.2"]);
    assert_eq!(decode(&dir.path().join("mine.gif")).pictures.len(), 5);
}

/// What `ffmpeg` is told and given, with a stand-in that counts; and what it complains of.
#[cfg(unix)]
#[test]
fn ffmpeg_gets_every_pixel_and_its_complaints_are_passed_on() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let tools = dir.path().join("tools");
    fs::create_dir(&tools).unwrap();
    let run = |answer: &str, work: &str| {
        let script = format!(
            "#!/bin/sh\ncase \"$*\" in *-encoders*) echo '{answer}'; exit;; esac\nfor out; do :; done\n{work}\n"
        );
        let ffmpeg = tools.join("ffmpeg");
        fs::write(&ffmpeg, script).unwrap();
        fs::set_permissions(&ffmpeg, fs::Permissions::from_mode(0o755)).unwrap();
        let path = format!("{}:/usr/bin:/bin", tools.display());
        let args = ["evaluate", POLICY, "--env", "hopper-morph", "--episodes", "1", "--video", "video.mp4"];
        let args = [&args[..], &SMALL, &["--video-seconds", "0.4", "--force"]].concat();
        program(dir.path(), &args).env("PATH", path).output().unwrap()
    };
    let output = run(" V libx264", "wc -c > \"$out\"; echo \"$*\" >> \"$out\"");
    assert!(output.status.success(), "{}", message(&output));
    let told = fs::read_to_string(dir.path().join("video.mp4")).unwrap();
    assert_eq!(told.split_whitespace().next(), Some((10 * 642 * 240 * 3).to_string().as_str()));
    for words in ["-video_size 642x240", "-framerate 1000000/40000", "-pix_fmt yuv420p", "libx264"] {
        assert!(told.contains(words), "{words}: {told}");
    }
    let whole = fs::read(dir.path().join("video.mp4")).unwrap();
    let output = run(" V libx264", "cat > /dev/null; echo 'no space on the moon' >&2; exit 3");
    assert_eq!(output.status.code(), Some(1));
    assert!(message(&output).contains("video.mp4") && message(&output).contains("no space on the moon"));
    // It goes before it has read anything.
    let output = run(" V libx264", "echo 'not today' >&2; exit 4");
    assert_eq!(output.status.code(), Some(1));
    assert!(message(&output).contains("not today"), "{}", message(&output));
    let output = run(" V mpeg4", "cat > /dev/null");
    assert_eq!(output.status.code(), Some(1));
    assert!(message(&output).contains("libx264"), "{}", message(&output));
    assert!(fs::read(dir.path().join("video.mp4")).unwrap() == whole, "what failed replaces nothing");
    assert_eq!(files(dir.path()).len(), 2, "nothing is left beside it");
}

/// A video that takes long, interrupted: exit code 130, and nothing is left.
#[cfg(unix)]
#[test]
fn an_interrupted_video_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let args = ["evaluate", POLICY, "--env", "hopper-morph", "--video", "video.gif", "--video-size", "1920x1080"];
    let mut child = silent(dir.path(), &args).spawn().unwrap();
    // The file in the making is there before the work begins, and after signals are listened to.
    let started = Instant::now();
    while files(dir.path()).is_empty() {
        assert!(started.elapsed() < Duration::from_secs(60), "no file in the making");
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(500));
    let id = child.id().to_string();
    assert!(std::process::Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(files(dir.path()), Vec::<PathBuf>::new());
}

#[test]
fn an_mp4_where_there_is_ffmpeg() {
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("SKIPPED: an_mp4_where_there_is_ffmpeg needs ffmpeg in PATH");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for out in ["one.mp4", "two.mp4"] {
        let report = video(dir.path(), "hopper-morph", out, &["--video-seconds", "1"]);
        assert_eq!(report[0]["video"]["frames"], 25);
    }
    let bytes = fs::read(dir.path().join("one.mp4")).unwrap();
    assert_eq!(&bytes[4..8], b"ftyp");
    assert!(bytes == fs::read(dir.path().join("two.mp4")).unwrap(), "the same video has the same bytes");
    let output = tce(dir.path(), &["evaluate", POLICY, "--env", "hopper", "--video", "one.mp4"]);
    assert_eq!(output.status.code(), Some(2), "it exists");
}

//! Words of messages: counts, and suggestions for unknown words.

use std::path::Path;

/// Two words are alike from here on (Jaro-Winkler, 0 to 1): one or two letters wrong, missing or swapped.
const ALIKE: f64 = 0.8;

/// `1 task`, `3 tasks`.
pub fn counted(n: usize, one: &str, many: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {many}") }
}

/// The most similar word of `known`, if any is similar enough.
pub fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let plain = |text: &str| text.to_lowercase().replace(['_', ' '], "-");
    let word = plain(word);
    let likeness = known.into_iter().map(|k| (k, strsim::jaro_winkler(&word, &plain(k))));
    // Of equals the first: lists stand in an order that means something.
    let best = likeness.fold(None::<(&str, f64)>, |best, (k, l)| match best {
        Some((_, b)) if b >= l => best,
        _ => Some((k, l)),
    });
    best.filter(|(_, likeness)| *likeness >= ALIKE).map(|(k, _)| k)
}

/// `; did you mean …?` after a message about `word`; nothing where no known word is much like it.
pub fn did_you_mean<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    nearest(word, known).map_or_else(String::new, |k| format!("; did you mean `{k}`?"))
}

/// `; did you mean FOLDER/FILE?` where a file was expected and `path` is a folder that holds files which `fits`. With several, the
/// shortest name; nothing where there is none.
pub fn file_inside(path: &Path, fits: impl Fn(&Path) -> bool) -> String {
    let mut inside: Vec<_> = std::fs::read_dir(path).into_iter().flatten().flatten().map(|e| e.path()).collect();
    inside.retain(|p| p.is_file() && fits(p));
    // `policy.safetensors` before `policy-seed0.safetensors`.
    inside.sort_by_key(|p| (p.as_os_str().len(), p.clone()));
    match &inside[..] {
        [] => String::new(),
        [one] => format!("; did you mean {}?", one.display()),
        [first, rest @ ..] => format!("; did you mean {}, or one of the {} beside it?", first.display(), rest.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural() {
        let said = [0, 1, 2].map(|n| counted(n, "task is", "tasks are"));
        assert_eq!(said, ["0 tasks are", "1 task is", "2 tasks are"]);
    }

    #[test]
    fn a_slip_is_found_and_another_word_is_not() {
        let known = ["hopper", "halfcheetah", "walker2d", "ant", "td3-bc"];
        for (word, expected) in [
            ("hoper", Some("hopper")),
            ("Hopper", Some("hopper")),
            ("walker", Some("walker2d")),
            ("half_cheetah", Some("halfcheetah")),
            ("td3bc", Some("td3-bc")),
            ("frog", None),
            ("", None),
        ] {
            assert_eq!(nearest(word, known), expected, "{word}");
        }
        assert_eq!(did_you_mean("hoper", known), "; did you mean `hopper`?");
        assert_eq!(did_you_mean("frog", known), "");
    }

    #[test]
    fn a_folder_is_answered_with_what_is_in_it() {
        let dir = tempfile::tempdir().unwrap();
        let hdf5 = |p: &Path| p.extension().is_some_and(|e| e == "hdf5");
        assert_eq!(file_inside(dir.path(), hdf5), "");
        std::fs::write(dir.path().join("b.hdf5"), "").unwrap();
        std::fs::write(dir.path().join("a.txt"), "").unwrap();
        assert_eq!(file_inside(dir.path(), hdf5), format!("; did you mean {}?", dir.path().join("b.hdf5").display()));
        std::fs::write(dir.path().join("a.hdf5"), "").unwrap();
        let several = file_inside(dir.path(), hdf5);
        assert_eq!(
            several,
            format!("; did you mean {}, or one of the 1 beside it?", dir.path().join("a.hdf5").display())
        );
    }
}

use tce_learn::Mode;

use super::*;
use crate::config::Algorithm;

pub fn plan(text: &str) -> Result<Manifest> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("my.toml");
    fs::write(&path, text).unwrap();
    Manifest::plan(&path)
}

pub const TWO: &str = r#"
    tasks = ["hopper-morph:medium->expert", "hopper-morph:medium->medium"]
    variants = ["tce-og", "tce-no-reg", "target-source"]
    seeds = 2
    preset = "quick"
"#;

#[test]
fn runs_share_what_they_need() {
    let manifest = plan(TWO).unwrap();
    let count = |kind| manifest.entries.iter().filter(|e| e.kind == kind).count();
    assert_eq!(count(Kind::Run), 2 * (3 + 5) * 2);
    // Two methods of one seed learn from the same generated rows.
    assert_eq!(count(Kind::Augment), 2 * 2);
    assert_eq!((count(Kind::Source), count(Kind::Target)), (1, 2));
    for entry in &manifest.entries {
        assert!(entry.needs.iter().all(|&n| manifest.entries[n].kind < entry.kind), "{entry}");
    }
    let generated = manifest.entries.iter().find(|e| e.variant == Some(Variant::TceOg)).unwrap();
    assert_eq!(generated.needs.len(), 3);
    let ids: BTreeSet<_> = manifest.entries.iter().map(|e| &e.id).collect();
    assert_eq!(ids.len(), manifest.entries.len());
}

#[test]
fn prior_methods_share_their_generated_rows() {
    let manifest = plan(
        r#"
        tasks = ["hopper-morph:medium->expert"]
        variants = ["dmc", "dmc-published", "synther", "tce-og"]
        baselines = false
        seeds = 2
        overrides = [
            { name = "", set = [] },
            { name = "w", set = ["learner.dmc.cut_off=0.2", "generator.y_max=0.1"] },
        ]
        "#,
    )
    .unwrap();
    let needs = |variant: Variant, label: &str, seed: u64| {
        let run = |e: &&Entry| e.variant == Some(variant) && e.label == label && e.seed == seed;
        let entry = manifest.entries.iter().find(run).unwrap();
        let kinds = entry.needs.iter().map(|&n| manifest.entries[n].kind).collect::<Vec<_>>();
        (entry.needs.last().copied().unwrap(), kinds)
    };
    let (dmc, kinds) = needs(Variant::Prior(Algorithm::Dmc, Mode::Corrected), "", 0);
    assert_eq!(kinds, [Kind::Target, Kind::Source, Kind::Augment]);
    assert_eq!(needs(Variant::Prior(Algorithm::Dmc, Mode::Published), "", 0).0, dmc);
    // Neither what the learner does with them, nor the keys of another generator, makes other rows.
    assert_eq!(needs(Variant::Prior(Algorithm::Dmc, Mode::Corrected), "w", 0).0, dmc);
    let (synther, kinds) = needs(Variant::Synther, "", 0);
    assert_eq!(kinds, [Kind::Target, Kind::Augment], "SynthER looks at no source");
    assert_eq!(needs(Variant::Synther, "w", 0).0, synther);
    assert_ne!(needs(Variant::Prior(Algorithm::Dmc, Mode::Corrected), "", 1).0, dmc);
    // dmc and synther, and tce-og under two y_max, of two seeds.
    assert_eq!(manifest.entries.iter().filter(|e| e.kind == Kind::Augment).count(), 2 * (2 + 2));
}

/// Rows that get the actions of clones wait for these, where the sweep has them; without, the run learns them itself.
#[test]
fn clones_come_before_the_rows_that_get_their_actions() {
    let tiers = |first: &str| {
        format!(
            r#"
            tasks = ["hopper-morph:medium->expert"]
            baselines = false
            seeds = 2
            tiers = [
                {{ name = "a", variants = ["tce-og", {first}] }},
                {{ name = "b", variants = ["tce-og"], overrides = [{{ name = "c", set = ["mixture.actions=clones"] }}] }},
            ]
            "#
        )
    };
    for (first, expected) in [("\"bc-ensemble\"", Some(Variant::BcEnsemble)), ("\"bc\"", None)] {
        let manifest = plan(&tiers(first)).unwrap();
        let by_clones: Vec<&Entry> = manifest.entries.iter().filter(|e| e.label == "c").collect();
        assert_eq!(by_clones.len(), 2);
        for run in by_clones {
            let runs: Vec<_> =
                run.needs.iter().map(|&n| &manifest.entries[n]).filter(|e| e.kind == Kind::Run).collect();
            let of = runs.iter().map(|e| (e.variant, e.seed)).collect::<Vec<_>>();
            assert_eq!(of, expected.iter().map(|&v| (Some(v), run.seed)).collect::<Vec<_>>());
            assert!(run.needs.iter().all(|&n| n < run.index));
        }
        // Their own actions wait for nothing.
        let own = manifest.entries.iter().find(|e| e.variant == Some(Variant::TceOg) && e.label.is_empty()).unwrap();
        assert!(own.needs.iter().all(|&n| manifest.entries[n].kind != Kind::Run));
    }
}

#[test]
fn a_plan_reads_back_and_damage_is_noticed() {
    let manifest = plan(TWO).unwrap();
    let text = manifest.to_jsonl();
    assert_eq!(Manifest::parse(&text, Path::new("m")).unwrap(), manifest);
    assert_eq!(plan(TWO).unwrap().to_jsonl(), text);
    let cut = &text[..text.len() - 40];
    let without_a_line = text.lines().enumerate().filter(|(k, _)| *k != 3).map(|(_, l)| format!("{l}\n"));
    let other_config = text.replacen("steps = 12000", "steps = 12001", 1);
    assert_ne!(other_config, text);
    for damaged in [cut.to_owned(), without_a_line.collect(), other_config, String::new()] {
        assert!(Manifest::parse(&damaged, Path::new("m")).is_err());
    }
}

#[test]
fn tasks_without_data_are_refused_or_left_out() {
    // The zoo has no expert of ant-gravity-5.
    let two = "tasks = [\"hopper-morph:medium->expert\", \"ant-gravity-5:medium->expert\"]\nvariants = [\"bc\"]\nfrom_zoo = true\n";
    let message = plan(two).unwrap_err().to_string();
    assert!(message.contains("not all data can be had") && message.contains("ant-gravity-5"), "{message}");
    let manifest = plan(&format!("{two}unavailable = \"skip\"\n")).unwrap();
    assert!(manifest.entries.iter().all(|e| e.task.agent == tce_data::Agent::Hopper));
    assert_eq!(manifest.entries.iter().filter(|e| e.kind == Kind::Run).count(), 5);
    let nothing = two.replace("\"hopper-morph:medium->expert\", ", "") + "unavailable = \"skip\"\n";
    assert!(plan(&nothing).unwrap_err().to_string().contains("not all data can be had"));
}

#[test]
fn nonsense_is_refused_before_anything_is_planned() {
    for (text, needle) in [
        ("tasks = []\nvariants = [\"bc\"]", "tasks"),
        ("tasks = [\"frog-*:medium->expert\"]\nvariants = [\"bc\"]", "matches none"),
        ("tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"frog\"]", "frog"),
        ("tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"bc\"]\nseeds = 1000000", "at most"),
        ("tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"bc\"]\nseed = 3", "seed"),
        ("tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"bc\"]\nset = [\"learner.frog=1\"]", "learner.frog"),
    ] {
        let message = plan(text).unwrap_err().to_string();
        assert!(message.contains(needle), "{message}");
    }
}

const TIERS: &str = r#"
    tasks = ["hopper-morph:medium->expert", "hopper-morph:medium->medium"]
    variants = ["tce-og"]
    baselines = false
    [[tiers]]
    name = "first"
    seeds = 2
    [[tiers]]
    name = "second"
    seeds = 3
    variants = ["bc", "tce-og"]
"#;

#[test]
fn tiers_come_one_after_the_other_and_share_their_work() {
    let manifest = plan(TIERS).unwrap();
    let runs: Vec<(&str, &str, u64, String)> = manifest
        .entries
        .iter()
        .filter(|e| e.kind == Kind::Run)
        .map(|e| (e.tier.as_str(), e.variant.unwrap().name(), e.seed, e.task.target.to_string()))
        .collect();
    let first = |seed| [("first", "tce-og", seed, "expert".to_owned()), ("first", "tce-og", seed, "medium".to_owned())];
    assert_eq!(runs[..4], [first(0), first(1)].concat());
    // Seeds 0 and 1 of tce-og are done by then.
    let bc = |seed| [("second", "bc", seed, "expert".to_owned()), ("second", "bc", seed, "medium".to_owned())];
    assert_eq!(runs[4..8], [bc(0), bc(1)].concat());
    assert_eq!(runs.len(), 4 + 6 + 2);
    // A task's rows stand right before the runs that need them.
    let kinds: Vec<Kind> = manifest.entries.iter().take(5).map(|e| e.kind).collect();
    assert_eq!(kinds, [Kind::Source, Kind::Target, Kind::Augment, Kind::Run, Kind::Target]);
    assert_eq!(Manifest::parse(&manifest.to_jsonl(), Path::new("m")).unwrap(), manifest);
    // Rows that a later tier adds under another task stand before those who need them.
    let other_order = TIERS.replace("name = \"first\"", "name = \"first\"\n    variants = [\"bc\"]").replace(
        "seeds = 3",
        "seeds = 3\n    tasks = [\"hopper-morph:medium->medium\", \"hopper-morph:medium->expert\"]",
    );
    let manifest = plan(&other_order).unwrap();
    assert_eq!(Manifest::parse(&manifest.to_jsonl(), Path::new("m")).unwrap(), manifest);
    for (change, needle) in [
        ("name = \"second\"\n    seeds = 0", "tier \"second\": there is nothing to run"),
        ("name = \"first\"\n    seeds = 3", "found the name \"first\", expected a different name"),
        ("name = \"second\"\n    seeds = 30000", "tier \"second\": 4 x 30000 runs; a sweep has at most"),
    ] {
        let message = plan(&TIERS.replace("name = \"second\"\n    seeds = 3", change)).unwrap_err().to_string();
        assert!(message.contains(needle), "{message}");
    }
    let column = |y: f64| format!("    overrides = [{{ name = \"y\", set = [\"generator.y_max={y}\"] }}]\n");
    let twice = TIERS.replace(
        "    [[tiers]]\n    name = \"second\"",
        &format!("{}    [[tiers]]\n    name = \"second\"", column(0.1)),
    );
    let message = plan(&(twice.clone() + &column(0.2))).unwrap_err().to_string();
    assert!(message.contains("tier \"second\": overrides: \"y\" sets"), "{message}");
    assert!(plan(&(twice + &column(0.1))).is_ok());
}

/// A verdict chooses once for a task and a seed, as soon as there are a baseline and a method.
#[test]
fn verdicts_choose_among_baselines_and_methods() {
    let text = "tasks = [\"hopper-morph:medium->expert\"]\nverdicts = true\n[[tiers]]\nname = \"a\"\nvariants = [\"tce-og\"]\nbaselines = false\n\
                [[tiers]]\nname = \"a, once more\"\nvariants = [\"tce-og\"]\nbaselines = false\n\
                [[tiers]]\nname = \"b\"\nvariants = [\"bc\"]\nbaselines = false\nseeds = 2\n\
                [[tiers]]\nname = \"c\"\nvariants = [\"otdf\"]\nbaselines = false\n";
    let manifest = plan(text).unwrap();
    let verdicts: Vec<&Entry> = manifest.entries.iter().filter(|e| e.kind == Kind::Verdict).collect();
    assert_eq!(verdicts.len(), 1, "seed 1 has a baseline alone");
    let names: Vec<&str> = verdicts[0].needs.iter().map(|&n| manifest.entries[n].variant.unwrap().name()).collect();
    // A run that two tiers share is one policy.
    assert_eq!((verdicts[0].tier.as_str(), verdicts[0].seed, names), ("b", 0, vec!["tce-og", "bc"]));
}

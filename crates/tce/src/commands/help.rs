//! What `--help` says besides the options: commands in groups, and examples.

use clap::Command;

/// All commands, in groups, in the order in which a reader wants them.
const GROUPS: [(&str, &[&str]); 6] = [
    ("The main job", &["run"]),
    ("Your own data", &["data", "augment", "learn", "compare"]),
    ("Policies and their data", &["evaluate", "export", "collect", "train-sac", "zoo"]),
    ("Many runs", &["sweep", "report"]),
    ("Looking deeper", &["diagnose", "config", "bench"]),
    ("The program itself", &["completions", "man", "help"]),
];

/// Examples of every command: what they do, and the line. A test calls clap with each of them.
const EXAMPLES: &[(&str, &[(&str, &str)])] = &[
    (
        "",
        &[
            ("the whole job, small, in minutes", "tce run hopper-morph/medium/expert --preset quick"),
            ("what is in a file of your own", "tce data check new_robot.hdf5"),
            ("a policy from two files of your own", "tce augment --source old.hdf5 --target new.hdf5 --out wider.hdf5"),
            ("", "tce learn --target new.hdf5 --extra wider.hdf5 --source old.hdf5 --out policy/"),
        ],
    ),
    (
        "run",
        &[
            ("a first look, in minutes", "tce run hopper-morph/medium/expert --preset quick"),
            ("a result: five seeds", "tce run ant-gravity/medium/expert --seeds 5"),
            (
                "two methods, without the simple ones",
                "tce run hopper-morph/medium/expert --variant tce-og,otdf --no-baselines",
            ),
            ("other settings", "tce run hopper-morph/medium/expert --set generator.y_max=0.1"),
        ],
    ),
    ("export", &[("a policy for ONNX runtimes", "tce export policy/policy.safetensors --onnx policy.onnx")]),
    (
        "augment",
        &[
            (
                "target rows and generated rows in one file",
                "tce augment --source old.hdf5 --target new.hdf5 --out wider.hdf5",
            ),
            ("the same for Minari", "tce augment --source old.hdf5 --target new.hdf5 --out wider --format minari"),
        ],
    ),
    (
        "learn",
        &[
            ("what learners there are", "tce learn --list"),
            (
                "a policy from both files, and which one to put on the robot",
                "tce learn --target new.hdf5 --extra wider.hdf5 --source old.hdf5 --out policy/",
            ),
            (
                "clones of the best tenth of the trajectories",
                "tce learn --target new.hdf5 --learner bc --top 0.1 --out clone/",
            ),
        ],
    ),
    (
        "evaluate",
        &[
            ("returns and score", "tce evaluate zoo:hopper-source-expert --env hopper --episodes 20"),
            (
                "a video beside the robot as it was",
                "tce evaluate policy.safetensors --env hopper-morph --video fall.gif",
            ),
        ],
    ),
    (
        "compare",
        &[(
            "two policies without a simulator",
            "tce compare a.safetensors b.safetensors --source old.hdf5 --target new.hdf5",
        )],
    ),
    (
        "train-sac",
        &[
            (
                "until a score is reached; the same line goes on after an interruption",
                "tce train-sac hopper --until-score 60",
            ),
            (
                "policies of several qualities, and the rows of the training",
                "tce train-sac hopper walker2d-morph --snapshot-scores 5,20,40 --replay",
            ),
        ],
    ),
    ("zoo list", &[("all actors", "tce zoo list")]),
    ("zoo show", &[("one actor", "tce zoo show hopper-source-medium")]),
    (
        "zoo rollout",
        &[("try actors, beside what their cards say", "tce zoo rollout hopper-source-medium --episodes 20")],
    ),
    (
        "zoo keep",
        &[(
            "make an actor of a trained policy",
            "tce zoo keep runs/sac/hopper-source-seed0/policy-40.safetensors --role medium",
        )],
    ),
    (
        "collect",
        &[
            (
                "D4RL's recipe, by the zoo's actors",
                "tce collect --env hopper --quality medium-replay --out replay.hdf5",
            ),
            (
                "a mixture of two policies",
                "tce collect --env ant-gravity --actor a.npz:0.3 --actor b.npz:0.7 --out x.hdf5",
            ),
        ],
    ),
    (
        "data inspect",
        &[
            ("rows, episodes, returns", "tce data inspect old.hdf5 new.hdf5"),
            ("every column", "tce data inspect new.hdf5 --dimensions"),
        ],
    ),
    (
        "data check",
        &[
            ("what was read, and what is wrong", "tce data check new.hdf5"),
            ("simulate every row of a robot of the benchmark", "tce data check hopper_morph_expert.hdf5 --replay"),
        ],
    ),
    (
        "data convert",
        &[
            ("Minari to D4RL's layout", "tce data convert minari-folder/ rows.hdf5"),
            ("and back", "tce data convert rows.hdf5 folder --format minari --id mine/rows-v0"),
        ],
    ),
    (
        "config show",
        &[
            ("every setting", "tce config show --preset quick"),
            ("one key, explained", "tce config show generator.y_max"),
            (
                "the keys of the learner, for a method on a task",
                "tce config show learner hopper-morph/medium/expert --variant otdf",
            ),
        ],
    ),
    (
        "diagnose",
        &[
            ("a finished run", "tce diagnose runs/hopper-morph_medium-to-expert/tce-og-0123456789ab"),
            ("your own files: no simulator needed", "tce diagnose --source old.hdf5 --target new.hdf5"),
        ],
    ),
    (
        "diagnose generator",
        &[
            (
                "two samplers with every noise process",
                "tce diagnose generator hopper-morph/medium/expert --samplers dpm:20,heun:18",
            ),
            ("every network that the training kept", "tce diagnose generator hopper-morph/medium/expert --cycles"),
        ],
    ),
    (
        "sweep plan",
        &[
            ("from a description to a list of work", "tce sweep plan examples/sweep.toml"),
            ("the paper's table, and what it would cost", "tce sweep plan examples/table.toml --dry-run --estimate"),
        ],
    ),
    (
        "sweep launch",
        &[
            ("two runs at a time, here; again after any accident", "tce sweep launch runs/sweeps/sweep --workers 2"),
            ("on a cluster", "tce sweep launch runs/sweeps/sweep --launcher slurm --sbatch=--time=04:00:00"),
        ],
    ),
    ("sweep run-one", &[("pieces 3 and 4 of the list", "tce sweep run-one runs/sweeps/sweep 3 4")]),
    ("sweep status", &[("again and again, until all is done", "tce sweep status runs/sweeps/sweep --watch")]),
    ("sweep gather", &[("verify all files, and make the table", "tce sweep gather runs/sweeps/sweep")]),
    (
        "sweep export",
        &[("what a sweep found, as one small file", "tce sweep export runs/sweeps/sweep --out results/mine.jsonl")],
    ),
    (
        "report",
        &[
            ("a page beside the sweep", "tce report runs/sweeps/sweep"),
            ("of runs of `tce run`, elsewhere", "tce report runs --out page"),
            ("records and a sweep as one", "tce report bench/results runs/sweeps/sweep --out page"),
        ],
    ),
    ("bench", &[("everything", "tce bench"), ("one loop, longer", "tce bench iql --repeats 11 --seconds 2")]),
    (
        "completions",
        &[
            ("bash", "tce completions bash > ~/.local/share/bash-completion/completions/tce"),
            ("zsh, in a folder of $fpath", "tce completions zsh > ~/.zfunc/_tce"),
            ("fish", "tce completions fish > ~/.config/fish/completions/tce.fish"),
        ],
    ),
    ("man", &[("all pages", "tce man --out ~/.local/share/man/man1")]),
];

/// `command` with groups and examples.
pub fn described(mut command: Command) -> Command {
    let groups = groups(&command);
    let (on, off) = styles(&command);
    for (path, examples) in EXAMPLES {
        let text = text_of(examples, &on, &off);
        command = at(command, &path.split_whitespace().collect::<Vec<_>>(), &|c| c.after_help(text.clone()));
    }
    command.help_template(format!(
        "{{about}}\n\n{{usage-heading}} {{usage}}\n\n{groups}{on}Global options:{off}\n{{options}}{{after-help}}"
    ))
}

/// clap's own style for headings; it is taken out again where there are no colours.
fn styles(command: &Command) -> (String, String) {
    let style = command.get_styles().get_header();
    (style.render().to_string(), style.render_reset().to_string())
}

fn groups(command: &Command) -> String {
    let (on, off) = styles(command);
    let literal = command.get_styles().get_literal();
    let about = |name: &str| match name {
        "help" => "Print this help, or that of a command".to_owned(),
        name => command.find_subcommand(name).and_then(Command::get_about).map_or_else(String::new, |a| a.to_string()),
    };
    let mut text = String::new();
    for (group, names) in GROUPS {
        text += &format!("{on}{group}:{off}\n");
        for name in names {
            let line = format!("  {name:<13}{}", about(name).trim_end_matches('.'));
            let line = match crate::output::width() {
                Some(width) => crate::output::break_line(&line, 15, width),
                None => line,
            };
            let (name, rest) = line[2..].split_at(name.len());
            text += &format!("  {literal}{name}{literal:#}{rest}\n");
        }
        text += "\n";
    }
    text
}

fn text_of(examples: &[(&str, &str)], on: &str, off: &str) -> String {
    let mut text = format!("{on}Examples:{off}\n");
    for (what, line) in examples {
        if !what.is_empty() {
            text += &format!("  # {what}\n");
        }
        text += &format!("  {line}\n");
    }
    text.trim_end().to_owned()
}

/// `command` with the command at `path` below it changed.
fn at(command: Command, path: &[&str], change: &dyn Fn(Command) -> Command) -> Command {
    match path.split_first() {
        None => change(command),
        Some((name, rest)) => command.mut_subcommand(name, |below| at(below, rest, change)),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::Cli;

    fn command() -> Command {
        described(Cli::command())
    }

    /// The words of a line, as a shell makes them; what goes into a file is the shell's.
    fn words(line: &str) -> Vec<String> {
        let line = line.split(" > ").next().unwrap();
        let mut words = Vec::new();
        for (k, part) in line.split('\'').enumerate() {
            match k % 2 {
                0 => words.extend(part.split_whitespace().map(str::to_owned)),
                _ => words.push(part.to_owned()),
            }
        }
        words
    }

    #[test]
    fn clap_takes_every_example() {
        for (path, examples) in EXAMPLES {
            for (_, line) in *examples {
                assert!(line.len() <= 78, "{line}: too long for a terminal");
                let words = words(line);
                assert!(path.is_empty() || words[1..].join(" ").starts_with(path), "{line}: no example of {path}");
                if let Err(e) = command().try_get_matches_from(&words) {
                    panic!("{line}: {e}");
                }
            }
        }
    }

    #[test]
    fn every_command_has_examples_and_a_group() {
        fn leaves(command: &Command, path: String, out: &mut Vec<String>) {
            let below: Vec<_> = command.get_subcommands().filter(|c| c.get_name() != "help").collect();
            if below.is_empty() || !command.is_subcommand_required_set() {
                out.push(path.trim().to_owned());
            }
            below.iter().for_each(|c| leaves(c, format!("{path} {}", c.get_name()), out));
        }
        let mut all = Vec::new();
        command().get_subcommands().for_each(|c| leaves(c, c.get_name().into(), &mut all));
        for path in &all {
            assert!(EXAMPLES.iter().any(|(p, _)| p == path), "{path}: no examples");
        }
        let grouped: Vec<&str> =
            GROUPS.iter().flat_map(|(_, names)| *names).copied().filter(|n| *n != "help").collect();
        let mut names: Vec<String> = command().get_subcommands().map(|c| c.get_name().to_owned()).collect();
        let mut grouped: Vec<String> = grouped.into_iter().map(str::to_owned).collect();
        names.sort();
        grouped.sort();
        assert_eq!(names, grouped);
    }

    #[test]
    fn global_options_come_last() {
        let mut command = command();
        command.build();
        let help = command.find_subcommand_mut("run").unwrap().render_long_help().to_string();
        let at = |heading: &str| help.find(&format!("\n{heading}:\n")).unwrap_or_else(|| panic!("{heading}: {help}"));
        assert!(at("Data") < at("Settings") && at("Settings") < at("Global options"), "{help}");
        assert!(at("Global options") < at("Examples"), "{help}");
    }
}

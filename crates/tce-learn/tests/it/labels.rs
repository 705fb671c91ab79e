//! Tests of inverse dynamics, rewards and terminals on a system with known laws.

use std::sync::Arc;

use rand::RngExt;
use tce_base::Streams;
use tce_data::{Standardizer, Transitions};
use tce_learn::pair_model::{PairConfig, PairInput};
use tce_learn::{LabelConfig, Member, TerminalHandling, train_labels};
use tce_nn::{Checkpoints, cpu};

/// s in [-3, 3]², s' = s + .05 a, r = s'_0 + 2, terminal where s'_0 > 2; a third dimension that is always 1.
fn data(rows: usize) -> Arc<Transitions> {
    let mut rng = Streams::new(2).stream("data");
    let mut t = Transitions::new(3, 2);
    for _ in 0..rows {
        let [x, y] = [0; 2].map(|_| rng.random_range(-3.0f32..3.0));
        let a = [0; 2].map(|_| rng.random_range(-1.0f32..1.0));
        let s2 = [x + 0.05 * a[0], y + 0.05 * a[1], 1.0];
        t.push(&[x, y, 1.0], &a, s2[0] + 2.0, &s2, s2[0] > 2.0, s2[0] <= 2.0);
    }
    Arc::new(t)
}

fn members(seeds: &[u64]) -> Vec<Member> {
    let data = data(2000);
    let member = |&seed: &u64| Member {
        streams: Streams::new(seed),
        parts: vec![data.clone()],
        standardizer: Standardizer::identity(3),
        reward_scale: 7.0,
        row_scores: None,
    };
    seeds.iter().map(member).collect()
}

fn config(input: PairInput) -> LabelConfig {
    let model = PairConfig { input, width: 48, ..PairConfig::default() };
    LabelConfig { model, steps: 1500, learn_terminals: true, ..LabelConfig::paper() }
}

#[test]
fn labels_follow_the_laws_of_the_system() {
    let models =
        train_labels(&members(&[1, 2]), &config(PairInput::Delta), &mut Checkpoints::none(), &cpu()).unwrap().unwrap();
    for errors in models.errors() {
        let errors = errors.unwrap();
        assert_eq!(errors.rows, 100);
        assert!(errors.action_rmse < 0.15 * errors.action_std, "{errors:?}");
        assert!(errors.reward_rmse < 0.1 * errors.reward_std, "{errors:?}");
        assert!(errors.terminal_error.unwrap() < 0.05, "{errors:?}");
    }
    // One action in the box, one that would be (3, 0); the second member has another number of rows.
    let s = vec![1.0, 0.0, 1.0, 1.0, 0.0, 1.0];
    let s2 = vec![1.02, -0.03, 1.0, 1.15, 0.0, 1.0];
    let ends = (vec![2.6, 0.0, 1.0], vec![2.6, 0.01, 1.0]);
    let generated = [(s.clone(), s2.clone()), ends];
    let labelled = models.label(&generated, TerminalHandling::Learned).unwrap();
    let t = &labelled[0].transitions;
    assert_eq!((t.len(), &t.observations, &t.next_observations), (2, &s, &s2));
    assert!((t.action(0)[0] - 0.4).abs() < 0.15 && (t.action(0)[1] + 0.6).abs() < 0.15, "{:?}", t.actions);
    assert_eq!(t.action(1)[0], 1.0);
    assert_eq!(labelled[0].outside_box, 0.25);
    assert!((t.rewards[0] - 3.02).abs() < 0.3, "{:?}", t.rewards);
    assert_eq!((&t.terminals, &t.timeouts), (&vec![false; 2], &vec![true; 2]));
    assert_eq!(labelled[1].transitions.terminals, [true]);

    let none = models.label(&generated, TerminalHandling::None).unwrap();
    assert_eq!(none[1].transitions.terminals, [false]);
    let rule = |_: &[f32], s2: &[f32]| s2[0] > 1.1;
    let ruled = models.label(&generated, TerminalHandling::Rule(&rule)).unwrap();
    assert_eq!(ruled[0].transitions.terminals, [false, true]);
    assert_eq!(ruled[0].transitions.timeouts, [true, false]);
    assert!(models.label(&generated[..1], TerminalHandling::None).is_err());
}

/// The target's rows never end an episode; the source's rows show which states do.
#[test]
fn terminals_are_learned_from_both_domains() {
    let source = data(2000);
    let inside: Vec<usize> = (0..2000).filter(|&i| !source.terminals[i]).collect();
    let target = Arc::new(source.select(&inside));
    let members: Vec<Member> =
        members(&[1]).into_iter().map(|m| Member { parts: vec![target.clone(), source.clone()], ..m }).collect();
    let models = train_labels(&members, &config(PairInput::Delta), &mut Checkpoints::none(), &cpu()).unwrap().unwrap();
    let pairs = (vec![2.5, 0.0, 1.0, -1.0, 0.0, 1.0], vec![2.5, 0.01, 1.0, -1.0, 0.01, 1.0]);
    let labelled = models.label(&[pairs], TerminalHandling::Learned).unwrap();
    assert_eq!(labelled[0].transitions.terminals, [true, false]);
}

#[test]
fn differences_carry_what_successors_hide() {
    let error = |input| {
        let models = train_labels(&members(&[1]), &config(input), &mut Checkpoints::none(), &cpu()).unwrap().unwrap();
        models.errors()[0].unwrap().action_rmse
    };
    let (delta, next) = (error(PairInput::Delta), error(PairInput::Next));
    assert!(delta < next, "{delta} {next}");
}

#[test]
fn a_classifier_that_is_not_there_is_refused() {
    let config = LabelConfig { steps: 1, ..config(PairInput::Delta) };
    let models = train_labels(
        &members(&[1]),
        &LabelConfig { learn_terminals: false, ..config },
        &mut Checkpoints::none(),
        &cpu(),
    )
    .unwrap()
    .unwrap();
    let error = models.label(&[(vec![0.0; 3], vec![0.0; 3])], TerminalHandling::Learned).unwrap_err();
    assert!(error.to_string().contains("learn_terminals"), "{error}");
}

//! Tests of complete learners on small problems with known answers.

use std::path::Path;
use std::sync::Arc;

use crate::common::go;
use rand::RngExt;
use tce_base::random::fill_normal;
use tce_base::{OrAuto, Streams};
use tce_data::{Standardizer, Transitions};
use tce_learn::dmc::{Dmc, DmcConfig};
use tce_learn::iql::{Iql, IqlConfig, PolicyExtraction};
use tce_learn::losses::AdvantageScale;
use tce_learn::regulariser::{Regulariser, RegulariserConfig, RegulariserKind};
use tce_learn::{
    ActorConfig, Bc, BcConfig, Buffer, CloneLoss, Journal, LabelConfig, LearnError, Learner, Member, Meter, Method,
    Mode, Place, Policy, PolicyLearner, Setup, best_trajectories, train_labels,
};
use tce_nn::{Checkpoints, cpu};

fn member(seed: u64, data: &Arc<Transitions>, standardised: bool) -> Member {
    let dim = data.obs_dim;
    let standardizer =
        if standardised { Standardizer::fit(&data.observations, dim) } else { Standardizer::identity(dim) };
    Member { streams: Streams::new(seed), parts: vec![data.clone()], standardizer, reward_scale: 1.0, row_scores: None }
}

fn run<L: Learner>(learner: &mut L, buffer: &Buffer, steps: u64) -> tce_learn::Report {
    go(learner, buffer, 0, steps)
}

fn action(policy: &Policy, observation: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; policy.dims().1];
    policy.act(observation, None, &mut out);
    out
}

/// a = (.5 x - .2, -.3 y) on states of very different scales.
fn linear_data() -> Arc<Transitions> {
    let mut rng = Streams::new(9).stream("data");
    let mut t = Transitions::new(2, 2);
    for _ in 0..2000 {
        let (x, y) = (rng.random_range(-1.0f32..1.0), rng.random_range(-1.0f32..1.0));
        t.push(&[x, 5.0 + 0.01 * y], &[0.5 * x - 0.2, -0.3 * y], 0.0, &[x, 5.0], false, true);
    }
    Arc::new(t)
}

#[test]
fn cloning_learns_a_linear_policy() {
    let data = linear_data();
    let buffer = Buffer::new(vec![member(1, &data, true), member(2, &data, true)], 64).unwrap();
    let actor = ActorConfig { hidden: vec![32, 32], lr: 3e-3, ..ActorConfig::default() };
    let config = BcConfig { actor, ..BcConfig::default() };
    let mut bc = Bc::new(&buffer, &config, 1500, &cpu()).unwrap();
    let report = run(&mut bc, &buffer, 1500);
    assert_eq!(report.step, 1500);
    for policy in bc.policies() {
        let a = action(&policy, &[0.4, 4.995]);
        assert!((a[0] - 0.0).abs() < 0.03 && (a[1] - 0.15).abs() < 0.03, "{a:?}");
    }
}

/// u = .8 x + noise, wide where x > 0 and narrow elsewhere; a = tanh u.
fn uneven_data() -> Arc<Transitions> {
    let mut rng = Streams::new(6).stream("uneven");
    let mut t = Transitions::new(1, 1);
    for _ in 0..4000 {
        let x = rng.random_range(-1.0f32..1.0);
        let mut noise = [0.0];
        fill_normal(&mut rng, &mut noise);
        let u = 0.8 * x + noise[0] * if x > 0.0 { 0.6 } else { 0.1 };
        t.push(&[x], &[u.tanh()], 0.0, &[x], false, true);
    }
    Arc::new(t)
}

#[test]
fn cloning_by_likelihood_learns_mean_and_spread() {
    let data = uneven_data();
    let buffer = Buffer::new(vec![member(1, &data, true)], 128).unwrap();
    let actor = ActorConfig { hidden: vec![64, 64], lr: 2e-3, ..ActorConfig::default() };
    let config = BcConfig { actor, ensemble: 2, loss: CloneLoss::Likelihood, ..BcConfig::default() };
    let mut bc = Bc::new(&buffer, &config, 3000, &cpu()).unwrap();
    run(&mut bc, &buffer, 3000);
    let policy = &bc.policies()[0];
    let file = &policy.to_parameters().metadata["policy"];
    assert!(file.contains("\"log_std_range\":[-3.0,1.0]"), "it samples as it was trained: {file}");
    for (x, spread) in [(-0.6f32, 0.1f32), (-0.3, 0.1), (0.4, 0.6), (0.7, 0.6)] {
        let mean = action(policy, &[x])[0].atanh();
        assert!((mean - 0.8 * x).abs() < 0.1, "mean at {x}: {mean}");
        let rows = 2000;
        let mut rngs: Vec<_> = (0..rows).map(|k| Streams::new(3).indexed("act", k)).collect();
        let mut sampled = vec![0.0; rngs.len()];
        policy.act(&vec![x; rngs.len()], Some(&mut rngs), &mut sampled);
        let squares: f32 = sampled.iter().map(|a| (a.clamp(-0.999, 0.999).atanh() - mean).powi(2)).sum();
        let found = (squares / rows as f32).sqrt();
        assert!(found / spread < 1.4 && spread / found < 1.4, "spread at {x}: {found}, in the data {spread}");
    }
}

/// a = sin(3 x) / 2 + noise of .3, as from a sampled behaviour policy; few rows.
fn noisy_data() -> Arc<Transitions> {
    let mut rng = Streams::new(5).stream("noisy");
    let mut t = Transitions::new(1, 1);
    for _ in 0..60 {
        let x = rng.random_range(-1.0f32..1.0);
        let noise = 0.3 * (rng.random_range(-1.0f32..1.0) + rng.random_range(-1.0f32..1.0));
        t.push(&[x], &[(3.0 * x).sin() / 2.0 + noise], 0.0, &[x], false, true);
    }
    Arc::new(t)
}

#[test]
fn dropout_keeps_a_clone_from_fitting_the_noise_of_its_rows() {
    let data = noisy_data();
    let buffer = Buffer::new(vec![member(1, &data, true), member(2, &data, true)], 64).unwrap();
    let error = |dropout: f64| {
        let actor = ActorConfig { hidden: vec![128, 128, 128], lr: 1e-3, ..ActorConfig::default() };
        let mut bc =
            Bc::new(&buffer, &BcConfig { actor, dropout: OrAuto::Given(dropout), ..BcConfig::default() }, 1500, &cpu())
                .unwrap();
        run(&mut bc, &buffer, 1500);
        // At the training rows themselves, anything fitted beyond the behaviour's mean is noise.
        let square = |policy: &Policy, i: usize| (action(policy, data.observation(i))[0] - data.action(i)[0]).powi(2);
        let policies = bc.policies();
        let all = policies.iter().flat_map(|p| (0..data.len()).map(|i| square(p, i)));
        (all.sum::<f32>() / (policies.len() * data.len()) as f32).sqrt()
    };
    let (without, with) = (error(0.0), error(0.4));
    assert!(with > 1.1 * without && with < 0.35, "error at the rows: {without} without, {with} with");
}

/// 600 rows of the action `of(state, noise)`.
fn rows_of(of: impl Fn(&[f32], f32) -> f32) -> Arc<Transitions> {
    let mut t = Transitions::new(8, 1);
    let (mut s, mut noise) = ([0.0; 8], [0.0]);
    let mut rng = Streams::new(3).stream("rows");
    for _ in 0..600 {
        fill_normal(&mut rng, &mut s);
        fill_normal(&mut rng, &mut noise);
        t.push(&s, &[of(&s, noise[0]).clamp(-1.0, 1.0)], 0.0, &s, false, true);
    }
    Arc::new(t)
}

/// The dropout of clones of `members` that are trained for `steps` steps at `place`.
fn dropout_of(members: Vec<Member>, steps: u64, place: Place<'_>) -> Vec<f64> {
    let config = BcConfig { dropout: OrAuto::Auto, ..BcConfig::default() };
    let (buffer, device) = (Buffer::new(members, 64).unwrap(), cpu());
    let (iql, behaviour) = (IqlConfig::paper(), RegulariserConfig::paper());
    let on = Setup { buffer: &buffer, steps, iql: &iql, behaviour: &behaviour, place, device: &device };
    let mut learner = config.build(&on).unwrap().expect("nobody interrupts");
    let mut meter = Meter::always();
    learner.update(&buffer.sample(0, &device), 0, &mut meter);
    meter.take()["dropout"].clone()
}

#[test]
fn the_data_tell_whether_clones_take_dropout() {
    let noisy = rows_of(|_, noise| 0.4 * noise);
    let exact = rows_of(|s, _| 0.5 * s[0]);
    let few = Arc::new(noisy.select(&(0..200).collect::<Vec<_>>()));
    let chosen = |members: Vec<Member>| dropout_of(members, 12_000, Place::NONE);
    let all = chosen(vec![member(1, &noisy, true), member(2, &exact, true), member(3, &noisy, true)]);
    assert_eq!(all, [0.3, 0.0, 0.3], "by the rows, whatever the seed");
    assert_eq!(chosen(vec![member(9, &exact, true)]), [0.0], "whoever the other members are");
    assert_eq!(chosen(vec![member(1, &few, true)]), [0.0], "too few rows to hold some out");
}

/// A trial leaves a checkpoint with the number of its job.
#[test]
fn jobs_with_the_same_rows_try_dropout_once() {
    let (noisy, exact) = (rows_of(|_, noise| 0.4 * noise), rows_of(|s, _| 0.5 * s[0]));
    let (directory, journal) = (tempfile::tempdir().unwrap(), Journal::default());
    let tried = |job: usize| {
        let of = |k: u32| directory.path().join(format!("prepare-choose-dropout-{job}.{k}.checkpoint"));
        of(0).exists() || of(1).exists()
    };
    let chosen = |job: usize, rows: &Arc<Transitions>| {
        let place = Place { directory: Some(directory.path()), key: "key", job, journal: Some(&journal) };
        dropout_of(vec![member(job as u64, rows, true)], 600, place)
    };
    let first = chosen(0, &noisy);
    // The second job has a copy of the rows.
    assert_eq!(chosen(1, &Arc::new(Transitions::clone(&noisy))), first);
    chosen(2, &exact);
    assert_eq!([0, 1, 2].map(tried), [true, false, true]);
    assert!(journal.take().is_empty(), "the metrics of the trials are nobody's");
}

#[test]
fn dropout_is_a_members_own_and_a_training_with_it_resumes() {
    let data = noisy_data();
    let members = [member(1, &data, true), member(2, &data, true)];
    let actor = ActorConfig { hidden: vec![16, 16], ..ActorConfig::default() };
    let config = BcConfig { actor, dropout: OrAuto::Given(0.3), ensemble: 2, ..BcConfig::default() };
    let new = |members: &[Member]| {
        let buffer = Buffer::new(members.to_vec(), 32).unwrap();
        (Bc::new(&buffer, &config, 20, &cpu()).unwrap(), buffer)
    };
    let ((mut whole, buffer), (mut one, own)) = (new(&members), new(&members[1..]));
    go(&mut whole, &buffer, 0, 20);
    go(&mut one, &own, 0, 20);
    let (a, b) = (action(&whole.policies()[1], &[0.3]), action(&one.policies()[0], &[0.3]));
    assert!((a[0] - b[0]).abs() < 1e-5, "{a:?} {b:?}");
    let (mut first, mut second) = (new(&members).0, new(&members).0);
    go(&mut first, &buffer, 0, 11);
    second.restore(&first.state(), Path::new("state")).unwrap();
    go(&mut second, &buffer, 11, 20);
    assert_eq!(whole.state(), second.state());
}

#[test]
fn a_member_equals_a_run_of_its_own_and_a_repetition_equals_itself() {
    let data = linear_data();
    let best = Arc::new(best_trajectories(&data, 0.5).unwrap());
    let members = [member(1, &data, false), member(2, &best, true), member(3, &data, true)];
    let config = IqlConfig { hidden: vec![32, 32], ..IqlConfig::paper() };
    let policies = |members: &[Member]| {
        let buffer = Buffer::new(members.to_vec(), 32).unwrap();
        let mut iql = Iql::new(&buffer, &config, Regulariser::None, 60, &cpu()).unwrap();
        run(&mut iql, &buffer, 60);
        iql.policies()
    };
    let (all, again, one) = (policies(&members), policies(&members), policies(&members[1..2]));
    for (a, b) in all.iter().zip(&again) {
        assert_eq!(a.to_parameters(), b.to_parameters());
    }
    let (a, b) = (action(&all[1], &[0.3, 5.002]), action(&one[0], &[0.3, 5.002]));
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-4), "{a:?} {b:?}");
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let data = linear_data();
    let members: Vec<_> = (1..3).map(|seed| member(seed, &data, true)).collect();
    let learn = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let buffer = Buffer::new(members.clone(), 256).unwrap();
            let mut iql = Iql::new(&buffer, &IqlConfig::paper(), Regulariser::None, 3, &cpu()).unwrap();
            run(&mut iql, &buffer, 3);
            let labels = LabelConfig { steps: 3, learn_terminals: true, ..LabelConfig::paper() };
            let labels = train_labels(&members, &labels, &mut Checkpoints::none(), &cpu()).unwrap().unwrap();
            (iql.state().to_bytes(), labels.state().to_bytes())
        })
    };
    assert!(learn(1) == learn(2), "another number of threads gave other parameters");
}

#[test]
fn a_resumed_training_goes_on_as_if_nothing_had_happened() {
    let data = linear_data();
    let buffer = Buffer::new(vec![member(1, &data, true), member(2, &data, true)], 32).unwrap();
    let config = IqlConfig { policy_extraction: PolicyExtraction::AwrLogprob, ..IqlConfig::paper() };
    let new = || Iql::new(&buffer, &config, Regulariser::None, 20, &cpu()).unwrap();
    let mut whole = new();
    go(&mut whole, &buffer, 0, 20);
    let mut first = new();
    go(&mut first, &buffer, 0, 11);
    let state = tce_nn::NamedParameters::from_bytes(&first.state().to_bytes(), Path::new("state")).unwrap();
    let mut second = new();
    second.restore(&state, Path::new("state")).unwrap();
    go(&mut second, &buffer, 11, 20);
    assert_eq!(whole.state(), second.state());
    let error = new().restore(&whole.policies()[0].to_parameters(), Path::new("other.safetensors")).unwrap_err();
    assert!(error.to_string().contains("other.safetensors"), "{error}");
}

/// A corridor: s = position in [-1, 1], a moves it by a/5, the reward is the new position. The behaviour moves left and
/// right at random, so the mean action is 0 and the best one is +1.
fn corridor() -> Arc<Transitions> {
    let mut rng = Streams::new(4).stream("corridor");
    let mut t = Transitions::new(1, 1);
    for _ in 0..200 {
        let mut x = rng.random_range(-1.0f32..1.0);
        for k in 0..20 {
            let a = if rng.random::<bool>() { 0.8 } else { -0.8 };
            let next = (x + 0.2 * a).clamp(-1.0, 1.0);
            t.push(&[x], &[a], next, &[next], false, k == 19);
            x = next;
        }
    }
    Arc::new(t)
}

fn corridor_config() -> IqlConfig {
    IqlConfig {
        hidden: vec![32, 32],
        discount: 0.9,
        critic_lr: 3e-3,
        polyak: 0.05,
        temperature: 10.0,
        actor: ActorConfig { hidden: vec![32, 32], lr: 3e-3, ..ActorConfig::default() },
        ..IqlConfig::paper()
    }
}

#[test]
fn iql_prefers_the_good_action_and_mean_weights_do_not() {
    let data = corridor();
    let buffer = Buffer::new(vec![member(1, &data, true)], 64).unwrap();
    let learn = |config: IqlConfig| {
        let mut iql = Iql::new(&buffer, &config, Regulariser::None, 2000, &cpu()).unwrap();
        let report = run(&mut iql, &buffer, 2000);
        (action(&iql.policies()[0], &[0.0])[0], report)
    };
    let (weighted, report) = learn(corridor_config());
    assert!(weighted > 0.5, "{weighted}");
    for name in ["value_loss", "critic_loss", "policy_loss", "weight_mean", "weight_capped", "weight_dead"] {
        assert!(report.metrics[name][0].is_finite(), "{name}");
    }
    let logprob = IqlConfig { policy_extraction: PolicyExtraction::AwrLogprob, ..corridor_config() };
    assert!(learn(logprob).0 > 0.5);
    let standardised = IqlConfig { temperature: 3.0, advantage: AdvantageScale::Standardised, ..corridor_config() };
    assert!(learn(standardised).0 > 0.5);
    // The broadcasting defect of OTDF's code: the advantages have no effect on which action is cloned.
    let mean = IqlConfig { policy_extraction: PolicyExtraction::MeanWeight, ..corridor_config() };
    assert!(learn(mean).0.abs() < 0.3);
}

/// A row's weight multiplies that row's own loss.
#[test]
fn weights_stay_with_their_rows() {
    use tce_learn::actor::Actor;
    use tce_nn::{host, tensor};
    let data = linear_data();
    let buffer = Buffer::new(vec![member(1, &data, true)], 3).unwrap();
    let actor = Actor::new(&buffer, &ActorConfig::default(), 1, &cpu()).unwrap();
    let batch = buffer.sample(0, &cpu());
    let output = actor.forward(batch.s.clone());
    let (mean, a, w) = (host(output.mean.clone()), host(batch.a.clone()), [2.0, 0.0, 5.0]);
    let row = |i: usize| ((mean[2 * i] - a[2 * i]).powi(2) + (mean[2 * i + 1] - a[2 * i + 1]).powi(2)) / 2.0;
    let expected = (0..3).map(|i| w[i] * row(i)).sum::<f32>() / 3.0;
    let loss = host(actor.imitation_loss(&output, batch.a, Some(tensor(w.to_vec(), [1, 3, 1], &cpu()))));
    assert!((loss[0] - expected).abs() < 1e-6, "{loss:?} {expected}");
}

/// With a strong term the policy approaches the target's behaviour (always right), although the source part (always
/// left) is half of every batch.
#[test]
fn regularisers_pull_the_policy_to_the_target_behaviour() {
    let side = |a: f32, rows: usize| {
        let mut rng = Streams::new(8).stream("side");
        let mut t = Transitions::new(1, 1);
        for _ in 0..rows {
            let x = rng.random_range(-1.0f32..1.0);
            t.push(&[x], &[a], 0.0, &[x], false, true);
        }
        Arc::new(t)
    };
    let (target, source) = (side(0.7, 200), side(-0.7, 400));
    let both = |seed| Member { parts: vec![target.clone(), source.clone()], ..member(seed, &target, true) };
    let buffer = Buffer::new(vec![both(1), both(2)], 64).unwrap();
    let mut config = RegulariserConfig { samples: 3, draws: 2, ..RegulariserConfig::paper() };
    (config.cvae.hidden, config.cvae.steps) = (vec![32], 400);
    let actions = |kind, beta_reg| -> Vec<f32> {
        let regulariser = Regulariser::prepare(kind, &buffer, &config, Place::NONE, &cpu()).unwrap().unwrap();
        let iql = IqlConfig { regulariser: kind, beta_reg, ..corridor_config() };
        let mut iql = Iql::new(&buffer, &iql, regulariser, 500, &cpu()).unwrap();
        run(&mut iql, &buffer, 500);
        iql.policies().iter().map(|p| action(p, &[0.1])[0]).collect()
    };
    assert!(actions(RegulariserKind::None, 1.0).iter().all(|a| a.abs() < 0.3));
    for (kind, beta_reg) in [(RegulariserKind::ForwardKl, 20.0), (RegulariserKind::Otdf, 1.0)] {
        let a = actions(kind, beta_reg);
        assert!(a.iter().all(|a| *a > 0.45), "{kind:?}: {a:?}");
    }
}

/// One member learns from target rows alone, the other from source rows, too: it has half as many target rows in a batch.
#[test]
fn members_with_other_shares_of_target_rows_are_refused_where_they_would_meet() {
    let rows = corridor();
    let mixed = Member { parts: vec![rows.clone(), rows.clone()], ..member(2, &rows, true) };
    let buffer = Buffer::new(vec![member(1, &rows, true), mixed], 64).unwrap();
    let mut config = RegulariserConfig { samples: 2, draws: 2, ..RegulariserConfig::paper() };
    (config.cvae.hidden, config.cvae.steps) = (vec![8], 1);
    let prepare = |kind| Regulariser::prepare(kind, &buffer, &config, Place::NONE, &cpu());
    let error = prepare(RegulariserKind::ForwardKl).err().unwrap().to_string();
    assert!(error.contains("found 64 target rows in a batch of member 0, 32 of member 1"), "{error}");
    assert!(prepare(RegulariserKind::Otdf).is_ok() && prepare(RegulariserKind::None).is_ok());
}

/// Two corridors. In the second, rows that move right have high scores.
fn scored_member(seed: u64) -> Member {
    let target = corridor();
    let others = corridor();
    let scores = others.actions.iter().map(|a| if *a > 0.0 { 0.9 } else { 0.2 }).collect();
    Member { parts: vec![target.clone(), others], row_scores: Some(Arc::new(scores)), ..member(seed, &target, true) }
}

fn small_behaviour() -> RegulariserConfig {
    let mut behaviour = RegulariserConfig { samples: 3, ..RegulariserConfig::paper() };
    (behaviour.cvae.hidden, behaviour.cvae.steps) = (vec![32], 300);
    behaviour
}

fn new_dmc(buffer: &Buffer, config: &DmcConfig, steps: u64) -> Result<Dmc, LearnError> {
    let behaviour = config.behaviour(&small_behaviour());
    let kind = RegulariserKind::Otdf;
    let regulariser = Regulariser::prepare(kind, buffer, &behaviour, Place::NONE, &cpu()).unwrap().unwrap();
    Dmc::new(buffer, config, &corridor_config(), regulariser, steps, &cpu())
}

/// Compares all results of one update with those of IQL on the rows and weights in the definition.
#[test]
fn dmc_is_iql_on_the_kept_rows_with_their_weights() {
    use tce_learn::Meter;
    use tce_nn::tensor;
    let buffer = Buffer::new(vec![scored_member(1), scored_member(2)], 32).unwrap();
    let behaviour = small_behaviour();
    let (config, base) = (DmcConfig::default(), corridor_config());
    let mut dmc = new_dmc(&buffer, &config, 5).unwrap();
    let regulariser = Regulariser::prepare(RegulariserKind::Otdf, &buffer, &behaviour, Place::NONE, &cpu());
    let regulariser = regulariser.unwrap().unwrap();
    let mut iql = Iql::new(&buffer, &config.backbone(&base), regulariser, 5, &cpu()).unwrap();
    for step in 0..5 {
        let batch = buffer.sample(step, &cpu());
        let (mut rows, mut weights) = (Vec::new(), Vec::new());
        for (member, picks) in buffer.members().iter().zip(batch.picks.chunks(32)) {
            let score = |i: usize| member.row_scores.as_ref().unwrap()[picks[i].row as usize];
            let mut others: Vec<usize> = (16..32).collect();
            others.sort_by(|&a, &b| score(b).partial_cmp(&score(a)).unwrap());
            let mut kept: Vec<usize> = (0..16).chain(others[..8].iter().copied()).collect();
            kept.sort_unstable();
            weights.extend(kept.iter().map(|&i| if i < 16 { 1.0 } else { score(i) }));
            rows.push(kept);
        }
        iql.step(&batch.keep(&rows), Some(tensor(weights, [2, 24, 1], &cpu())), step, &mut Meter::default());
        dmc.update(&batch, step, &mut Meter::default());
    }
    assert_eq!(dmc.state(), iql.state());
}

#[test]
fn dmc_goes_on_from_its_state_and_refuses_rows_without_scores() {
    let buffer = Buffer::new(vec![scored_member(1)], 32).unwrap();
    let new = || new_dmc(&buffer, &DmcConfig::default(), 20).unwrap();
    let mut whole = new();
    go(&mut whole, &buffer, 0, 20);
    let mut first = new();
    go(&mut first, &buffer, 0, 11);
    let mut second = new();
    second.restore(&first.state(), Path::new("state")).unwrap();
    go(&mut second, &buffer, 11, 20);
    assert_eq!(whole.state(), second.state());

    let error = |member: Member| {
        let buffer = Buffer::new(vec![member], 32).unwrap();
        new_dmc(&buffer, &DmcConfig::default(), 20).err().unwrap().to_string()
    };
    assert!(error(Member { row_scores: None, ..scored_member(1) }).contains("member 0, row_scores"));
    assert!(error(member(1, &corridor(), true)).contains("DmC compares the two"));
    let rows = scored_member(1).parts[1].len();
    let bad = Member { row_scores: Some(Arc::new(vec![f32::NAN; rows])), ..scored_member(1) };
    assert!(error(bad).contains("a finite number for each"));
}

/// Every fifth row is terminal and without s', and has no score. What stands in the place of s' has no effect.
#[test]
fn dmc_learns_from_rows_without_a_successor() {
    let log = |instead: f32| {
        let mut t = Transitions::clone(&corridor());
        for i in (4..t.len()).step_by(5) {
            (t.terminals[i], t.timeouts[i], t.known[i]) = (true, false, false);
            t.next_observations[i] = instead;
        }
        Arc::new(t)
    };
    let learned = |instead: f32| {
        let rows = log(instead);
        let scores = (0..rows.with_successors().len()).map(|i| 0.1 + (i % 9) as f32 / 10.0).collect();
        let parts = vec![rows.clone(), rows.clone()];
        let member = Member { parts, row_scores: Some(Arc::new(scores)), ..member(1, &rows, true) };
        let buffer = Buffer::new(vec![member], 32).unwrap();
        let mut dmc = new_dmc(&buffer, &DmcConfig::default(), 12).unwrap();
        go(&mut dmc, &buffer, 0, 12);
        dmc.state()
    };
    assert!(learned(0.0) == learned(50.0));
}

/// The best action is +1, the behaviour's mean is 0. Corrected mode finds it. Published mode clones the rows left by
/// the filter (two thirds of them move right), because its weights do not distinguish rows.
#[test]
fn dmc_learns_and_its_modes_differ() {
    let buffer = Buffer::new(vec![scored_member(1)], 64).unwrap();
    let learn = |mode| {
        let config = DmcConfig { mode, beta_reg: 0.01, ..DmcConfig::default() };
        let mut dmc = new_dmc(&buffer, &config, 1200).unwrap();
        run(&mut dmc, &buffer, 1200);
        action(&dmc.policies()[0], &[0.0])[0]
    };
    let (corrected, published) = (learn(Mode::Corrected), learn(Mode::Published));
    assert!(corrected > 0.55, "{corrected}");
    assert!(published > 0.05 && published < 0.5, "{published}");
}

//! `tce diagnose generator`.

use clap::Args;
use serde::Serialize;
use tce_base::{Streams, counted};
use tce_data::{Standardizer, Task};
use tce_diffusion::metrics::sliced_wasserstein;
use tce_diffusion::{Edm, Process, Sampler, Ve, Vp};
use tce_learn::TerminalHandling;
use tce_nn::Device;
use tce_run::augment::{finisher, label_models, networks, support};
use tce_run::diagnosis::cycles::{Asked, AtCycle, Cycles, cycles};
use tce_run::diagnosis::generator::{Consistency, Quality, Tried, consistency, hold_out, step_std};
use tce_run::error::Result;
use tce_run::inputs::{DataArgs, Inputs};
use tce_run::layers::ConfigArgs;
use tce_run::variant::Variant;

use crate::output::{Output, table};

/// Arguments of `generator`.
#[derive(Debug, Args)]
pub struct GeneratorArgs {
    /// The task.
    task: Task,
    /// Rows to sample for each metric.
    #[arg(long, default_value_t = 4096)]
    rows: usize,
    /// Share of the target rows (whole episodes) to hold out.
    #[arg(long, default_value_t = 0.2)]
    held_out: f64,
    #[command(flatten)]
    data: DataArgs,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The noise processes, separated by commas: ve, vp, edm, each with its defaults.
    #[arg(long, value_delimiter = ',', value_parser = process, default_value = "ve,vp,edm")]
    processes: Vec<Process>,
    /// The samplers, separated by commas: pc:STEPS, euler:STEPS, heun:STEPS, dpm:STEPS, sde-dpm:STEPS.
    #[arg(long, value_delimiter = ',', value_parser = sampler, default_value = "pc:500,heun:18,dpm:20")]
    samplers: Vec<Sampler>,
    /// The networks at the ends of q_tran's training cycles instead, on all target rows and from the stage that `tce run` uses: losses,
    /// consistency, implied actions and what the implied policy scores. For generator.transition_steps = "auto".
    #[arg(long, conflicts_with_all = ["processes", "samplers", "only", "held_out"])]
    cycles: bool,
    /// Episodes of the implied policy for each network.
    #[arg(long, default_value_t = 10, requires = "cycles")]
    episodes: usize,
    /// Only the configured process and sampler instead.
    #[arg(long, conflicts_with_all = ["processes", "samplers"])]
    only: bool,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Serialize)]
struct Report {
    task: Task,
    training_rows: usize,
    held_out_rows: usize,
    /// SW between training and held-out states: what a perfect copy of the training rows would get.
    sw_floor: f64,
    /// Real rows with inferred actions.
    real: Consistency,
    rows: Vec<Row>,
}

#[derive(Serialize)]
struct Row {
    process: &'static str,
    sampler: String,
    #[serde(flatten)]
    quality: Quality,
}

fn process(name: &str) -> std::result::Result<Process, String> {
    match name {
        "ve" => Ok(Process::Ve(Ve::default())),
        "vp" => Ok(Process::Vp(Vp::default())),
        "edm" => Ok(Process::Edm(Edm::default())),
        _ => Err("expected ve, vp or edm".into()),
    }
}

fn sampler(text: &str) -> std::result::Result<Sampler, String> {
    let expected = "expected pc, euler, heun, dpm or sde-dpm, a colon, and the number of steps, as in dpm:20";
    let (kind, steps) = text.split_once(':').ok_or(expected)?;
    let steps = steps.parse().map_err(|_| expected)?;
    let sampler = match (kind, Sampler::paper()) {
        ("pc", Sampler::PredictorCorrector { snr, corrections, .. }) => {
            Sampler::PredictorCorrector { steps, snr, corrections }
        }
        ("euler", _) => Sampler::EulerMaruyama { steps },
        ("heun", _) => Sampler::Heun { steps },
        ("dpm", _) => Sampler::DpmSolver { steps },
        ("sde-dpm", _) => Sampler::SdeDpmSolver { steps },
        _ => return Err(expected.into()),
    };
    sampler.check().map_err(|e| e.to_string())?;
    Ok(sampler)
}

fn process_name(process: &Process) -> &'static str {
    match process {
        Process::Ve(_) => "VE as written",
        Process::Vp(_) => "VP",
        Process::Edm(_) => "EDM",
    }
}

fn sampler_name(sampler: &Sampler) -> String {
    match sampler {
        Sampler::PredictorCorrector { steps, .. } => format!("PC-{steps}"),
        Sampler::EulerMaruyama { steps } => format!("Euler-Maruyama-{steps}"),
        Sampler::Heun { steps, .. } => format!("Heun-{steps}"),
        Sampler::DpmSolver { steps, .. } => format!("DPM++(2M)-{steps}"),
        Sampler::SdeDpmSolver { steps, .. } => format!("SDE-DPM++(2M)-{steps}"),
    }
}

impl GeneratorArgs {
    /// Runs the subcommand.
    pub fn run(self, output: Output, device: &Device) -> Result<()> {
        tce_sim::open_library()?;
        if self.cycles {
            return self.cycles(output, device);
        }
        let config = self.config.layered(Some(self.task), None)?.config()?;
        let inputs = Inputs::of_config(self.task, &self.data, &config)?;
        let (training, held_out) = hold_out(&inputs.target.rows, self.held_out);
        let hash = format!("{} without its last {} rows", inputs.target.hash, held_out.len());
        let inputs = inputs.with_target(training, hash);
        let training = &*inputs.imitated(&config.target);
        let support = support(&inputs, &config);
        let seeds = [self.seed];
        let (models, ..) = label_models(&inputs, &config.labels, &seeds, &self.data.out, device)?;
        let place = (self.task.agent, self.task.shift);

        let processes = match self.only {
            true => vec![config.generator.process],
            false => self.processes,
        };
        let samplers = match self.only {
            true => vec![config.generator.sampler],
            false => self.samplers,
        };
        let mut rows = Vec::new();
        let mut floors = None;
        for process in processes {
            let generator_config = tce_augment::config::GeneratorConfig { process, ..config.generator.clone() };
            let varied = tce_run::config::Config { generator: generator_config.clone(), ..config.clone() };
            let (generator, ..) = networks(&inputs, &varied, &seeds, &self.data.out, device)?;
            let finisher = finisher(&generator.units, &models, &config, &inputs);
            if floors.is_none() {
                let units = &generator.units;
                let d = units.live.len();
                let scale = Standardizer::fit(&units.take(&training.observations), d);
                let states = |t: &tce_data::Transitions| scale.apply(&units.take(&t.observations));
                let sw = sliced_wasserstein(&states(training), &states(&held_out), d, 256, &Streams::new(self.seed));
                let pair = (held_out.observations.clone(), held_out.next_observations.clone());
                let real = models.label(&[pair], TerminalHandling::None)?.remove(0).transitions;
                floors =
                    Some((sw, consistency(place.0, place.1, &real, &step_std(training, &units.live), &units.live)?));
            }
            let tried = Tried {
                generator: &generator,
                models: &models,
                config: &generator_config,
                finisher: &finisher,
                training,
                held_out: &held_out,
                support: support.as_ref(),
                place,
            };
            for sampler in &samplers {
                let quality = tried.quality(sampler, self.rows, self.seed)?;
                tce_base::note!(
                    "{} {}: SW to held-out states {:.3}, consistency {:.3}",
                    process_name(&process),
                    sampler_name(sampler),
                    quality.sw_held_out,
                    quality.consistency.median
                );
                rows.push(Row { process: process_name(&process), sampler: sampler_name(sampler), quality });
            }
        }
        let (sw_floor, real) = floors.expect("at least one process");
        let report = Report {
            task: self.task,
            training_rows: training.len(),
            held_out_rows: held_out.len(),
            sw_floor,
            real,
            rows,
        };
        output.print(&report, render);
        Ok(())
    }

    fn cycles(self, output: Output, device: &Device) -> Result<()> {
        let config = self.config.layered(Some(self.task), Some(Variant::TceOg))?.config()?;
        let inputs = Inputs::of_config(self.task, &self.data, &config)?;
        let place = (self.task.agent, self.task.shift);
        let said =
            |n: &AtCycle| tce_base::note!("{}: action RMSE {}, score {}", n.cells()[0], n.cells()[4], n.cells()[10]);
        let asked = Asked { place, seed: self.seed, rows: self.rows, episodes: self.episodes };
        let cycles = cycles(&inputs, &config, asked, &self.data.out, device, said)?;
        output.print(&CyclesReport { task: self.task, episodes: self.episodes, cycles }, render_cycles);
        Ok(())
    }
}

#[derive(Serialize)]
struct CyclesReport {
    task: Task,
    /// Episodes behind every score.
    episodes: usize,
    #[serde(flatten)]
    cycles: Cycles,
}

fn render_cycles(r: &CyclesReport) -> String {
    let c = &r.cycles;
    let spread = c.networks.iter().find_map(|n| n.actions.trained).map_or(f64::NAN, |e| e.spread);
    let behaviour = c.behaviour_score.map_or("unknown".into(), |s| format!("{s:.1}"));
    format!(
        "{}: q_tran of {}, trained on {} rows, {} held out; the target's actions spread by {spread:.3}, its data score {behaviour}\n\
         consistency of real rows with inferred actions: {:.3} (p90 {:.3})\n{}\n\
         Action RMSE: Inv(s, ŝ') with ŝ' of q_tran against the behaviour's own action, one draw and the mean of 8, at rows that q_tran saw \
         and rows that it did not.\nScore: the policy s -> Inv(s, ŝ') over {}. Networks are done when action RMSE and score no longer \
         get better.",
        r.task,
        c.stage,
        c.target_rows.0,
        c.target_rows.1,
        c.real.median,
        c.real.p90,
        table(&AtCycle::HEADER, c.networks.iter().map(AtCycle::cells)),
        counted(r.episodes, "episode", "episodes")
    )
}

fn render(r: &Report) -> String {
    let lines = r.rows.iter().map(|row| {
        let q = &row.quality;
        [
            row.process.to_owned(),
            row.sampler.clone(),
            q.evaluations.to_string(),
            format!("{:.3}", q.sw_training),
            format!("{:.3}", q.sw_held_out),
            format!("{:.3}", q.std_ratio),
            format!("{:.1}", q.largest),
            format!("{:.3} / {:.3}", q.consistency.median, q.consistency.p90),
            format!("{:.3} / {:.3}", q.consistency_expanded.median, q.consistency_expanded.p90),
            format!("{:.0}", q.rows_per_second),
        ]
    });
    let header = [
        "process",
        "sampler",
        "NFE",
        "SW train",
        "SW held out",
        "std ratio",
        "max",
        "consistency y=0",
        "expanded",
        "rows/s",
    ];
    format!(
        "{}: {} training rows, {} held out\nSW between training and held-out rows: {:.3}; consistency of held-out rows with \
         inferred actions: {:.3} (p90 {:.3})\n{}",
        r.task,
        r.training_rows,
        r.held_out_rows,
        r.sw_floor,
        r.real.median,
        r.real.p90,
        table(&header, lines)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samplers_are_named_by_kind_and_steps() {
        assert_eq!(sampler("pc:500"), Ok(Sampler::paper()));
        assert_eq!(sampler("sde-dpm:12"), Ok(Sampler::SdeDpmSolver { steps: 12 }));
        for wrong in ["dpm", "dpm:x", "ode:3", "heun:1"] {
            assert!(sampler(wrong).is_err(), "{wrong}");
        }
    }
}

//! The table of what policies are worth without a simulator: `learn` and `compare` show the same columns in the same words.

use crate::output::table;

/// A line of the table.
pub struct Estimated {
    /// The policy's name or file.
    pub policy: String,
    /// Mean return of its episodes in learned dynamics.
    pub imagined_return: f64,
    /// The same while the episodes are near the target's states.
    pub supported_return: f64,
    /// Standard error of [`Estimated::supported_return`].
    pub standard_error: f64,
    /// Share of an episode of which that return tells; None in verdicts of older versions.
    pub support: Option<f64>,
    /// Discounted return by fitted Q evaluation and its standard error; None where it was not asked for.
    pub fitted_q: Option<[f64; 2]>,
    /// RMSE against the target rows' own actions.
    pub action_error: f64,
}

/// The table and what its columns mean. `logged` is the discounted return of the target's episodes as they were logged.
pub fn estimates(policies: impl Iterator<Item = Estimated>, logged: Option<f64>) -> String {
    let rows = policies.map(|e| {
        [
            e.policy,
            format!("{:.1}", e.imagined_return),
            format!("{:.1} ± {:.1}", e.supported_return, e.standard_error),
            e.support.map_or("-".into(), |share| format!("{:.0} %", 100.0 * share)),
            e.fitted_q.map_or("-".into(), |[value, error]| format!("{value:.1} ± {error:.1}")),
            format!("{:.3}", e.action_error),
        ]
    });
    let logged = logged.map(|value| {
        let name = "the target's logged episodes".to_owned();
        [name, "-".into(), "-".into(), "-".into(), format!("{value:.1}"), "0".into()]
    });
    let header = ["policy", "imagined return", "supported", "support", "fitted Q", "action error"];
    format!(
        "Estimated without a simulator (± standard error):\n{}\n\
         imagined return: of episodes in learned dynamics of the robot\n\
         supported: the imagined return until the episode is far from every target state; recommendations go by it. If\n\
         rewards can be negative, each later step counts as a bad reward, so that leaving early does not pay\n\
         support: share of a whole episode's steps before that, or before the imagined episode ends\n\
         fitted Q: return with each later reward worth 1 % less, by fitted Q evaluation on the target's rows\n\
         action error: RMSE against the target rows' own actions, in a range of 2; it tells how closely they are cloned\n",
        table(&header, rows.chain(logged)),
    )
}

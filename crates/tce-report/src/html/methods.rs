//! How the figures are made.

use maud::{Markup, html};

use super::term;
use crate::analysis::Analysis;

pub(super) fn methods(analysis: &Analysis) -> Markup {
    html! {
        p {
            "A run is one policy of one seed. Its score is 100 (J − J" sub { "random" } ") / (J" sub { "expert" } " − J" sub { "random" }
            "), with J the mean undiscounted return of its evaluation episodes after the last update, and the reference returns that its \
             settings name (" code { "evaluation.scores" } ")."
        }
        p {
            b { "Baselines. " }
            "Cloning of the target rows with raw and with standardised observations, cloning of the best half of the trajectories, and \
             implicit Q-learning (IQL) on the target rows alone. The best baseline is the one with the highest interquartile mean on the \
             compared tasks. It is chosen by its scores, which favours the baselines."
        }
        p {
            b { "Statistics. " }
            "As in Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice (2021), and their package rliable: \
             interquartile mean, median, mean, optimality gap, performance profiles, probability of improvement (a tie counts one half), \
             and percentile intervals of a bootstrap with " (analysis.resamples) " resamples (a fifth of them for profiles), stratified \
             by task. Every task has the same weight. The paper gives means and deviations only, so that its rows have no interval."
        }
        p {
            b { "Findings. " }
            "A method beats the best baseline, or falls short of it, on two conditions. The interval of its "
            (term("improvement", "probability of improvement")) " lies on one side of one half. And a "
            (term("p", "permutation test")) ", which deals each task's runs out to both methods anew, reaches p ≤ "
            (format!("{:.2}", 1.0 - analysis.level)) ". The test is needed because the interval of few runs can shrink to a point: that two \
             runs score higher than two others happens by chance in one of six cases."
        }
        p {
            b { "Missing and failed runs. " }
            "A run that is not done, or whose files have changed, is counted nowhere, and listed above. A policy that "
            (term("diverged", "diverged")) " is a result: it counts as 0 points, a random policy's score. Methods are compared only on tasks that all of them have; where \
             that is fewer than half of what the fullest method has, the method with the fewest tasks is left out, and named. With unequal numbers of seeds every task \
             counts the same."
        }
        p {
            b { "What the intervals do not say. " }
            "Each interval is of one method, not of all at once: among twenty methods that are equal to the baseline, one is expected to \
             look different. With few seeds the intervals are too narrow. Tasks that share a robot or a data set are not independent of each other."
        }
    }
}

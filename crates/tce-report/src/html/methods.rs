//! How the figures are made.

use maud::{Markup, html};

use crate::analysis::Analysis;

pub(super) fn methods(analysis: &Analysis) -> Markup {
    html! {
        p {
            "A run is one policy of one seed. Its score is 100 (J − J" sub { "random" } ") / (J" sub { "expert" } " − J" sub { "random" }
            "), with J the mean undiscounted return of its evaluation episodes after the last update, and the reference returns that its \
             settings name (" code { "evaluation.scores" } ")."
        }
        p {
            b { "Floors. " }
            "Cloning of the target rows with raw and with standardised observations, cloning of the best half of the trajectories, and \
             IQL on the target rows alone. The best floor is the one with the highest interquartile mean on the compared tasks; it is \
             chosen after the fact, which is to the methods' disadvantage if anything."
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
            "A method beats the best floor, or falls short of it, if the interval of its probability of improvement lies on one side of one \
             half, and a permutation test, which deals each task's runs out to both anew, reaches p ≤ " (format!("{:.2}", 1.0 - analysis.level))
            ". The test is there because a bootstrap of few runs can shrink to a point: two runs above two others are nothing \
             extraordinary, for all that the interval says."
        }
        p {
            b { "Missing and failed runs. " }
            "A run that is not done, or whose files are not what they were, is counted nowhere, and listed above. A policy that diverged \
             is a result: it counts as 0 points, a random policy's score. Methods are compared only on tasks that all of them have; where \
             that is fewer than half of what the fullest method has, the method with the fewest tasks is left out, and named. With unequal numbers of seeds every task \
             keeps its weight, and its runs share it."
        }
        p {
            b { "What the intervals do not say. " }
            "They are one by one, not for all methods at once: of twenty true ties one is expected to look like a difference. With few \
             seeds they are too narrow. Tasks that share a robot or a data set are not independent of each other."
        }
    }
}

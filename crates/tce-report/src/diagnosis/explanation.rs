//! How the figures of a diagnosis are made.

use maud::{Markup, html};
use tce_diagnosis::advice::{LOSS, REACH, STEP, SURE, percent};
use tce_diagnosis::coverage::NEIGHBOUR;
use tce_diagnosis::memorisation::BESIDE;

pub(super) fn explanation() -> Markup {
    html! {
        div class="note" {
            p {
                b { "Whether to use the rows. " } "One of these speaks against them: the policy that they teach scores less than the target \
                 data by more than " (percent(LOSS)) " of that score, even when " (SURE) " standard errors of the mean over episodes are \
                 added to it; the actions that they teach are no nearer to the behaviour's than its mean action; they reach less than "
                (percent(REACH)) " of what a second sample of the target reaches; their steps are off by more than " (STEP)
                " of a usual step; or they are copies. Only the score of the policy speaks for them, when it is not lower by more than "
                (percent(LOSS)) " even with " (SURE) " standard errors taken off. Otherwise the data do not tell. Good rows need not make a \
                 policy better than the target rows alone do: only scores tell that."
            }
            p {
                b { "Coverage. " } "A real state is reached if a generated state is nearer to it than its " (NEIGHBOUR)
                "th nearest neighbour among the real states of the same robot (Naeem et al. 2020). The paper draws such a curve and does \
                 not define it. All sets have the same number of rows: rows of the very same distribution reach 97 %. The target's states \
                 are one half of its rows, and the second sample of the target is the other half, in whole episodes where they can be split \
                 evenly. The generator was trained on both halves."
            }
            p {
                b { "Reliability. " } "The few target rows are compared with many: what the simulator makes of states and actions of target, \
                 source and generated rows. The generated ones among them are another sample than the one that is measured. Kept and \
                 rejected rows are the two parts of one sample."
            }
            p {
                b { "Copies. " } "The rows of every episode, and as large a share of the generated rows, are measured by their nearest \
                 training row in the other episodes (after Meehan et al. 2020). The figure is how often the generated row is the nearer \
                 one. Fresh rows have one half. Rows are called copies if they are nearer to what copies would have than to one half, and \
                 said to lie beside the data below " (percent(BESIDE)) ". The measure needs episodes that visit the same states. Where every \
                 episode is in a place of its own, fresh rows have what copies have; exact copies are counted separately."
            }
            p {
                b { "Implied policy. " } "At a real target state s the generator draws a next state ŝ', and the inverse dynamics model tells \
                 the action that leads there. A policy that learns from generated rows imitates these actions. Rows can agree with the \
                 physics and still teach a behaviour that nobody had. Where the behaviour's own actions are noisy, no generator can \
                 foresee the noise: a draw of exactly this noise is √2 times the noise's size away from the behaviour's action. Networks \
                 that were trained too briefly draw actions that scatter more than the behaviour's, and their policy scores less."
            }
            p {
                b { "Label error against distance. " } "Rows that pass the filter, of all y_max together, sorted by distance into bins of \
                 equally many rows. The unit of distance is the median distance of a target state to the nearest one of another episode. \
                 The error is the difference between the generated next state and what the simulator makes of the same state and action, \
                 in usual steps. Without a simulator it is how far three models of the target's steps are apart, each of which lacks a third \
                 of the target rows."
            }
            p {
                b { "Theorem 1. " } "The bound is λ times the mean discrepancy of the source rows used, plus 1 − λ times that of the generated \
                 rows. The discrepancy of a row is the difference between its next state and the next state that the target's dynamics give, \
                 in value (Eq. 4; V is that of implicit Q-learning on target and generated rows) or as total variation (Eq. 3). By the \
                 simulator, the target's dynamics are the simulator. By the data alone, they are models of the target rows: three, each of \
                 which lacks a third of the rows. The band around a line by the data alone is its doubt: how far the three models are apart, \
                 and the error of a finite sample, in which every trajectory counts once. A λ is told from 0 only where the bound at 0 lies \
                 outside of its band. For total variation the band holds the error of the sample alone. In a deterministic world total \
                 variation is near 1 wherever sharp models differ at all, so that the bound on values is the one to look at."
            }
        }
    }
}

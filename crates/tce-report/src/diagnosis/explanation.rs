//! How the figures of a diagnosis are made.

use maud::{Markup, html};
use tce_diagnosis::coverage::NEIGHBOUR;
use tce_diagnosis::memorisation::BESIDE;

pub(super) fn explanation() -> Markup {
    html! {
        div class="note" {
            p {
                b { "Coverage. " } "A state of either domain is covered if a generated state lies within the distance of its "
                (NEIGHBOUR) "th nearest neighbour among the states of its own domain (Naeem et al. 2020); the paper does not define its \
                 curve. All sets have the same number of rows, so that rows of the very same distribution cover 97 %. What is covered of the \
                 target is one half of its rows, and the covering target rows are of the other half: whole episodes where they can be split \
                 evenly. The generator saw both."
            }
            p {
                b { "Reliability. " } "Lines are medians, bands reach from the 10th to the 90th percentile. Abundant rows are what the \
                 simulator makes of states and actions of target, source and generated rows (a sample that is not measured). The kept and \
                 the rejected rows are two parts of one sample."
            }
            p {
                b { "Copies. " } "The rows of every episode, and as large a share of the generated rows, are measured by their nearest training row of \
                 the other episodes (after Meehan et al. 2020). P is the probability that the generated row is the nearer one: one half for \
                 fresh rows. Rows are called copies from half the way between that and what copies get, and beside the data below "
                (BESIDE) ". Exact copies are counted as well. Where every episode is a place of its own, fresh rows get the P of copies."
            }
            p {
                b { "Implied policy. " } "At a real target state s the generator draws a successor ŝ', and the inverse dynamics model infers \
                 the action that leads there. Whoever learns from generated rows imitates these actions: rows may agree with the physics \
                 and still belong to a behaviour that nobody had. The difference holds the noise of the behaviour's own actions, which \
                 no generator can foresee; a draw of exactly the behaviour's noise is √2 times as far from it as the noise is wide. Networks \
                 that were trained too briefly draw actions that are farther apart than the behaviour's, and the rollout scores less."
            }
            p {
                b { "Label error against distance. " } "Rows that pass the filter under all y_max together, in bins of as many rows each; the \
                 line is the median of a bin, the band reaches from the 10th to the 90th percentile. The unit of distance is the median distance of a \
                 target state to the nearest one of another episode. The error is the difference between the generated successor and what \
                 the simulator does at (ŝ, â), in units of the spread of the target's steps: 1 is as wrong as a whole step. Without a \
                 simulator it is how far models that lack a third of the target rows each are apart."
            }
            p {
                b { "Theorem 1. " } "Expectations over ρ" sub { "mix" } " are means over source rows for the first term and over generated rows for the \
                 second; V at one generated successor stands for its expectation, so that the second is an upper estimate. V is that of implicit Q-learning on target and generated \
                 rows. By the data alone, the target's dynamics are models of the target rows: for values three that lack a third of the \
                 rows each, whole episodes where they are even enough, V at the step that they predict, and for total variation one of all rows. Otherwise they are the simulator, and \
                 for total variation a model of abundant rows. The band is the doubt: the rule tells a λ from 0 where \
                 the bound at 0 lies outside of it. It holds the errors of finite samples, in which every trajectory counts once, for nine \
                 comparisons at once, and for values how far the three models are apart; for total variation, samples alone. In a \
                 deterministic world the total variation of sharp models is near 1 wherever they differ at all: the bound on values is the one \
                 that tells rows apart."
            }
        }
    }
}

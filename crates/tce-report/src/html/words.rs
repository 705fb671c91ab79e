//! The words of the pages, explained: at their first use a link with the meaning under the pointer, at the end of the page a list.

use maud::{Markup, html};

/// A word and what it means.
struct Word {
    /// What it is linked by.
    id: &'static str,
    /// In print.
    word: &'static str,
    /// In one or two sentences.
    meaning: &'static str,
}

const fn word(id: &'static str, word: &'static str, meaning: &'static str) -> Word {
    Word { id, word, meaning }
}

/// In the order of the list.
static WORDS: &[Word] = &[
    word(
        "source",
        "Source and target",
        "The source is the old robot, with many logged transitions. The target is the changed robot that a policy is wanted for, with few.",
    ),
    word(
        "generated",
        "Generated rows",
        "Transitions of the target robot that two diffusion models make up, in addition to the logged ones. A row is one transition \
         (state s, action a, reward r, next state s').",
    ),
    word(
        "score",
        "Normalised score",
        "A policy's mean return on a scale on which a random policy has 0 and an expert of the target robot 100. A point is one \
         hundredth of that distance.",
    ),
    word(
        "baseline",
        "Baseline",
        "A simple method that a result has to beat to be worth its effort: cloning the target rows (BC), and implicit \
         Q-learning (IQL) on the target rows alone. The best one is that with the highest \
         interquartile mean on the compared tasks.",
    ),
    word("bc", "BC", "Behaviour cloning: a network is trained to repeat the actions of the data."),
    word(
        "iqm",
        "IQM, interquartile mean",
        "The mean of the middle half of all runs: the lowest and the highest quarter are left out, so that a single run cannot decide it.",
    ),
    word(
        "seed",
        "Seed",
        "The number that all randomness of a run starts from. Runs that differ in nothing but the seed show how much of a score is luck.",
    ),
    word(
        "interval",
        "Bootstrap interval",
        "The runs are drawn anew, with replacement, thousands of times. The interval holds the given share of the figures that come out. \
         It tells how much other seeds might have changed the figure.",
    ),
    word(
        "improvement",
        "Probability of improvement",
        "The share of all pairs, a run of the method and a run of the baseline on the same task, in which the method's run scores \
         higher. One half means no difference.",
    ),
    word(
        "p",
        "p, permutation test",
        "How often a difference at least as large comes about when the runs of both methods are mixed and dealt out again by chance. \
         Where it is small enough, the difference is called more than chance.",
    ),
    word(
        "profile",
        "Performance profile",
        "For every score, the share of runs that are above it. A curve farther to the right is better.",
    ),
    word("gap", "Optimality gap", "How many points the runs are below 100 on average. A run above 100 counts as 100."),
    word(
        "regret",
        "Regret",
        "How many points the best of all policies scores more than the recommended one. The recommendation is made from the data \
         alone, before any score is known.",
    ),
    word(
        "preset",
        "Preset",
        "A named set of all settings. quick: a test that takes minutes. default: what measures best. paper: as the paper describes it.",
    ),
    word("updates", "Learner updates", "How many gradient steps the policy's training took."),
    word(
        "y",
        "y, ŷ and y_max",
        "The generator of states is told by a label y whose states to draw: 0 for the target robot's, 1 for the source's. Generated \
         states get labels ŷ between 0 and y_max. The larger y_max, the farther they reach towards the source's states.",
    ),
    word(
        "lambda",
        "λ (lambda)",
        "The share of real source rows in the data that a policy learns from; the rest is generated. λ = 0 is TCE(OG), only generated \
         rows. TCE(NN) adds the source rows nearest to the target's.",
    ),
    word(
        "coverage",
        "Coverage",
        "The share of a robot's real states that have a generated state as near as one of their few nearest neighbours among the \
         real states.",
    ),
    word(
        "filter",
        "Filter, z-score",
        "The filter rejects generated rows that have a component farther than z_th standard deviations from the mean of all generated rows.",
    ),
    word(
        "consistency",
        "Dynamics consistency",
        "How far a generated next state is from what the simulator makes of the same state and action. The unit is the usual size of a \
         step: 0 is exact, 1 is as wrong as a whole step.",
    ),
    word(
        "implied",
        "Implied policy",
        "The policy that generated rows teach: at a real state the generator draws a next state, and the inverse dynamics model tells \
         the action that leads there. Whoever learns from the rows imitates these actions.",
    ),
    word(
        "inverse",
        "Inverse dynamics model",
        "A network that tells the action from a state and the next one. It labels generated rows with actions.",
    ),
    word("rms", "RMS, RMSE", "The root of the mean square: the typical size of a difference or of an error."),
    word(
        "kl",
        "Transition KL",
        "The Kullback-Leibler divergence between two models of the target's dynamics at a generated row, one learned from the few \
         target rows, one from many simulated rows. 0 means that the few rows are enough there.",
    ),
    word(
        "theorem",
        "Theorem 1",
        "The paper's upper bound on how much a policy can lose because its data are not of the target robot, as a function of λ. Lower \
         is better.",
    ),
    word(
        "tsne",
        "Picture (t-SNE)",
        "A map of rows in the plane. Rows that are near in the picture are near in truth. Directions and large distances mean nothing.",
    ),
    word(
        "expectile",
        "Expectile",
        "The setting of implicit Q-learning between the mean (0.5) and the maximum (1) of the returns seen.",
    ),
    word(
        "diverged",
        "Diverged",
        "The policy's network gave numbers that are not finite. Such a policy counts as 0 points.",
    ),
];

fn find(id: &str) -> &'static Word {
    WORDS.iter().find(|w| w.id == id).expect("the words of the pages are in the list")
}

/// `text`, linked to the word's meaning.
pub(crate) fn term(id: &str, text: &str) -> Markup {
    let word = find(id);
    html! { a class="term" href=(format!("#word-{}", word.id)) title=(word.meaning) { (text) } }
}

/// The list of the words that `body` links to, in the order of the list.
pub(crate) fn list(body: &str) -> Markup {
    let mut linked = Vec::new();
    for w in WORDS.iter().filter(|w| body.contains(&format!("href=\"#word-{}\"", w.id))) {
        linked.push(w);
    }
    html! {
        dl class="words" {
            @for w in linked { dt id=(format!("word-{}", w.id)) { (w.word) } dd { (w.meaning) } }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_listed_once_and_in_sentences() {
        for (k, w) in WORDS.iter().enumerate() {
            assert!(WORDS[..k].iter().all(|other| other.id != w.id), "{}", w.id);
            assert!(w.meaning.ends_with('.') && !w.meaning.contains("  "), "{}", w.meaning);
        }
        let listed = list(&term("iqm", "interquartile mean").into_string()).into_string();
        assert!(listed.contains("id=\"word-iqm\"") && !listed.contains("word-seed"), "{listed}");
    }
}

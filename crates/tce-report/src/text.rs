//! The report's tables as Markdown and as LaTeX.

use tce_base::counted;

use crate::analysis::{Analysis, Cell, ShiftTable, opening};
use crate::study::{Study, shift_title, short};

/// A table: a header, and rows of as many cells. The first column is text.
struct Table {
    title: String,
    header: Vec<String>,
    rows: Vec<Vec<String>>,
    /// Rows that follow a rule.
    rules: Vec<usize>,
    /// What a reader has to know of it.
    doubt: Option<String>,
}

fn title(analysis: &Analysis, m: usize) -> String {
    let mark = if analysis.needs_mark(m) { " (published mode)" } else { "" };
    format!("{}{mark}", analysis.methods[m].title)
}

fn cell(cell: Option<&Cell>) -> String {
    let Some(c) = cell else { return "–".into() };
    let std = c.std.map_or_else(String::new, |s| format!(" ± {s:.1}"));
    format!("{:.1}{std}{}", c.mean, if c.diverged > 0 { "†" } else { "" })
}

fn shift_table(analysis: &Analysis, t: &ShiftTable) -> Table {
    let columns = t.paper.map_or(&[][..], |p| &p.columns[..]);
    let ours = (0..analysis.methods.len()).map(|m| title(analysis, m));
    let papers = columns.iter().map(|c| format!("{} (paper, Table {})", c.method, c.table));
    let mut rows: Vec<Vec<String>> = t
        .rows
        .iter()
        .map(|r| {
            let ours = r.cells.iter().map(|c| cell(c.as_ref()));
            let papers = r.paper.iter().map(|p| p.map_or("–".into(), |p| format!("{:.1} ± {:.1}", p.mean, p.std)));
            std::iter::once(short(&r.task)).chain(ours).chain(papers).collect()
        })
        .collect();
    let of = |n: usize| if n < t.rows.len() { format!(" (of {n} tasks)") } else { String::new() };
    let ours_total = t.totals.iter().map(|x| match x {
        None => "–".into(),
        Some(x) => format!("{}{}", x.estimate.told(1), of(x.tasks)),
    });
    let paper_total = t.paper_totals.iter().map(|(sum, n)| match n {
        0 => "–".to_owned(),
        n => format!("{sum:.1}{}", of(*n)),
    });
    rows.push(std::iter::once("Total".into()).chain(ours_total).chain(paper_total).collect());
    Table {
        title: shift_title(t.shift).into(),
        header: std::iter::once("Task".into()).chain(ours).chain(papers).collect(),
        rules: vec![rows.len() - 1],
        rows,
        doubt: t.doubt.clone(),
    }
}

fn statistics(analysis: &Analysis) -> Option<Table> {
    let c = analysis.comparison.as_ref()?;
    let mut header: Vec<String> =
        ["Method", "Runs", "Interquartile mean", "Mean", "Median", "Optimality gap", "Total"].map(Into::into).to_vec();
    header.extend(c.baselines.iter().map(|f| format!("P(> {})", analysis.methods[*f].title)));
    header.extend(["Points above the best baseline", "Finding"].map(Into::into));
    let rows = c.methods.iter().map(|a| {
        let [iqm, median, mean, gap] = a.over_seeds;
        let mut row = vec![title(analysis, a.method), a.runs.to_string()];
        row.extend([iqm, mean, median, gap, a.total].iter().map(|e| e.told(1)));
        match &a.over_baselines {
            Some(over) => row.extend(over.iter().map(|e| e.told(2))),
            None => row.extend(c.baselines.iter().map(|_| "–".into())),
        }
        row.push(c.gap(a).map_or("–".into(), |gap| format!("{gap:+.1}")));
        row.push(match (analysis.methods[a.method].baseline, c.improvement(a)) {
            (true, _) if c.best_baseline() == Some(a.method) => "the best baseline".into(),
            (true, _) => "baseline".into(),
            (false, Some((_, finding))) => finding.word().into(),
            (false, None) => "–".into(),
        });
        row
    });
    Some(Table {
        title: format!("Statistics over {}", counted(c.tasks.len(), "task", "tasks")),
        header,
        rows: rows.collect(),
        rules: Vec::new(),
        doubt: None,
    })
}

fn tables(analysis: &Analysis) -> Vec<Table> {
    statistics(analysis).into_iter().chain(analysis.tables.iter().map(|t| shift_table(analysis, t))).collect()
}

fn caption(study: &Study, analysis: &Analysis) -> String {
    format!(
        "Preset {}{}. {} of {} runs have a result. Normalised scores (0: a random policy, 100: an expert), mean ± standard deviation \
         over seeds; brackets: {:.0} % intervals of a bootstrap stratified by task; † with a diverged policy, counted as 0.",
        analysis.recipes.names(),
        analysis.recipes.updates().map_or_else(String::new, |u| format!(", {u} learner updates")),
        study.runs.len(),
        study.runs.len() + study.missing.len(),
        100.0 * analysis.level
    )
}

/// Cases of a warning that are listed: Markdown cannot fold the rest away.
const CASES: usize = 10;

/// The report's tables, warnings and finding in Markdown.
pub fn markdown(study: &Study, analysis: &Analysis) -> String {
    let mut out = format!("# {}\n\n{}\n\n", md(&study.name), md(&opening(analysis).join(" ")));
    for w in &analysis.warnings {
        out += &format!("> **Note.** {}\n", md(&w.text));
        for d in w.details.iter().take(CASES) {
            out += &format!("> - {}\n", md(d));
        }
        if w.details.len() > CASES {
            out += &format!("> - and {} more, all of them in report.html\n", w.details.len() - CASES);
        }
        out += ">\n";
    }
    out += &format!("\n{}\n", md(&caption(study, analysis)));
    for t in tables(analysis) {
        let line = |cells: &[String]| format!("| {} |\n", cells.iter().map(|c| md(c)).collect::<Vec<_>>().join(" | "));
        let rule: String = (0..t.header.len()).map(|k| if k == 0 { "|---" } else { "|---:" }).collect();
        let doubt = t.doubt.as_ref().map_or_else(String::new, |d| format!("{}\n\n", md(d)));
        out += &format!("\n## {}\n\n{doubt}{}{rule}|\n", t.title, line(&t.header));
        out.extend(t.rows.iter().map(|r| line(r)));
    }
    out
}

/// Text that Markdown and the HTML in it leave alone.
fn md(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '\n' | '\r' => out.push(' '),
            '\\' | '`' | '*' | '_' | '|' | '[' | ']' | '#' | '~' | '!' => {
                out.push('\\');
                out.push(c);
            }
            c => out.push(c),
        }
    }
    out
}

/// The report's tables in LaTeX, for `\input`; needs the packages booktabs, graphicx and textcomp.
pub fn latex(study: &Study, analysis: &Analysis) -> String {
    let mut out = String::from("% Made by `tce report`. \\usepackage{booktabs,graphicx,textcomp}\n");
    for w in &analysis.warnings {
        out += &format!("% Note: {}\n", w.text.replace(['\n', '\r'], " "));
    }
    for t in tables(analysis) {
        let line =
            |cells: &[String]| format!("  {} \\\\\n", cells.iter().map(|c| tex(c)).collect::<Vec<_>>().join(" & "));
        let doubt = t.doubt.as_ref().map_or_else(String::new, |d| format!(" {}", tex(d)));
        out += &format!(
            "\n\\begin{{table}}[t]\n\\centering\n\\caption{{{}: {}. {}{doubt}}}\n\\resizebox{{\\linewidth}}{{!}}{{%\n\\begin{{tabular}}{{l{}}}\n\\toprule\n",
            tex(&study.name),
            tex(&t.title),
            tex(&caption(study, analysis)),
            "r".repeat(t.header.len() - 1),
        );
        out += &line(&t.header);
        out += "\\midrule\n";
        for (k, row) in t.rows.iter().enumerate() {
            if t.rules.contains(&k) {
                out += "\\midrule\n";
            }
            out += &line(row);
        }
        out += "\\bottomrule\n\\end{tabular}}\n\\end{table}\n";
    }
    out
}

/// Text that LaTeX prints as it is.
fn tex(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' => out += "\\textbackslash{}",
            '~' => out += "\\textasciitilde{}",
            '^' => out += "\\textasciicircum{}",
            '<' => out += "\\textless{}",
            '>' => out += "\\textgreater{}",
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(c);
            }
            '±' => out += "$\\pm$",
            '→' => out += "$\\to$",
            '†' => out += "\\textdagger{}",
            '−' => out += "$-$",
            '–' => out += "--",
            '\u{a0}' => out += "~",
            '\n' | '\r' => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn special_characters_print_as_themselves() {
        assert_eq!(md("a|b <i>*x*\n"), "a\\|b &lt;i&gt;\\*x\\* ");
        assert_eq!(tex("5% of a_b & \\x"), "5\\% of a\\_b \\& \\textbackslash{}x");
    }
}

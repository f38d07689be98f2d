//! Draws the charts and writes the tables of `docs/PERFORMANCE.md`, from files of results and from the stored counts
//! of instructions.
//!
//! - Files of results: `docs/performance/data/*.json`, written by `benches/peers` with `--json FILE`. Several files are
//!   runs of one machine: each figure is the median of the runs, with the least in brackets.
//! - Counts of instructions: `benches/instructions/figures.json`.
//! - Charts: `docs/performance/charts/*.svg`.
//! - Tables: the lines of `docs/PERFORMANCE.md` between `<!-- table: NAME -->` and `<!-- end of table -->`.

mod bars;
mod charts;
mod instructions;
mod merged;
mod numbers;
mod paths;
mod tables;

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::Parser;
use sinew_figures::results::BenchRun;

use crate::{instructions::Instructions, merged::Merged};

const DATA: &str = "docs/performance/data";
const CHARTS: &str = "docs/performance/charts";
const PAGE: &str = "docs/PERFORMANCE.md";
const INSTRUCTIONS: &str = "benches/instructions/figures.json";

/// Draws the charts and writes the tables of docs/PERFORMANCE.md.
#[derive(Parser)]
struct Arguments {
    /// Write nothing. Exit code 1: a chart or a table is not that of the results
    #[arg(long)]
    check: bool,
    /// Files of results, all of one machine; without any, those of docs/performance/data
    files: Vec<PathBuf>,
}

fn main() -> ExitCode {
    let Arguments { check, files } = Arguments::parse();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let outputs = match outputs(&root, files) {
        Ok(outputs) => outputs,
        Err(why) => return failed(&why),
    };
    let mut is_current = true;
    for output in outputs.iter().filter(|output| !output.is_current(&root)) {
        is_current = false;
        if check {
            println!("{} is not that of the results: run `cargo run -p sinew-charts`", output.path);
        } else if let Err(why) = output.write(&root) {
            return failed(&format!("{}: {why}", output.path));
        } else {
            println!("{}", output.path);
        }
    }
    if is_current || !check { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn failed(why: &str) -> ExitCode {
    eprintln!("{why}");
    ExitCode::from(2)
}

/// A file that this program writes.
struct Output {
    /// Relative to the root.
    path: String,
    text: String,
}

impl Output {
    fn is_current(&self, root: &Path) -> bool {
        fs::read_to_string(root.join(&self.path)).is_ok_and(|text| text == self.text)
    }

    fn write(&self, root: &Path) -> std::io::Result<()> {
        let path = root.join(&self.path);
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        fs::write(path, &self.text)
    }
}

/// Returns all charts, and the page with its tables.
fn outputs(root: &Path, mut files: Vec<PathBuf>) -> Result<Vec<Output>, String> {
    if files.is_empty() {
        files = data_files(&root.join(DATA))?;
    }
    let runs = files.iter().map(|file| BenchRun::read(file)).collect::<Result<_, _>>()?;
    let merged = Merged::new(runs)?;
    let instructions = Instructions::parse(&read(&root.join(INSTRUCTIONS))?)
        .map_err(|why| format!("{INSTRUCTIONS}: {why}"))?;
    let page = read(&root.join(PAGE))?;
    let page = tables::replaced(&page, "peers", &tables::peers(&merged))
        .and_then(|page| tables::replaced(&page, "instructions", &tables::instructions(&instructions)))
        .map_err(|why| format!("{PAGE}: {why}"))?;
    let charts = charts::all(&merged, &instructions)?;
    let charts = charts.into_iter().map(|(name, text)| Output { path: format!("{CHARTS}/{name}.svg"), text });
    Ok(charts.chain([Output { path: PAGE.to_owned(), text: page }]).collect())
}

fn read(path: &Path) -> Result<String, String> {
    fs::read_to_string(path).map_err(|why| format!("{}: {why}", path.display()))
}

/// Returns the files of results in a folder, in the order of their names.
fn data_files(folder: &Path) -> Result<Vec<PathBuf>, String> {
    let entries = fs::read_dir(folder).map_err(|why| format!("{}: {why}", folder.display()))?;
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let mut files: Vec<_> = paths.filter(|path| path.extension().is_some_and(|end| end == "json")).collect();
    files.sort();
    Ok(files)
}

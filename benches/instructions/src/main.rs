//! Counts the instructions of a round trip on six paths of a message, and compares them with stored figures.
//!
//! A clock on a shared machine differs from run to run. The number of instructions hardly does, so that it shows a
//! change of a few percent. Each path runs under `valgrind --tool=callgrind`, which counts what all threads of a
//! process execute outside the kernel. Each process of a path is counted. A path runs twice, with few and with many
//! round trips: the difference is free of start and stop.
//!
//! The stored figures are in `figures.json`, for each compiler, C library and profile.

mod callgrind;
mod ends;
#[path = "../../../actors/benches/gncl/nodes.rs"]
#[allow(dead_code, reason = "other benches use the rest")]
mod nodes;
mod paths;
#[path = "../../../actors/benches/ping/mod.rs"]
mod ping;
mod stored;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use sinew_figures::{End, Pinning};

use crate::{paths::Path, stored::Verdict};

/// Runs of a path at most, if each has more instructions than stored.
const RUNS: usize = 5;

/// Counts the instructions of a round trip on six paths of a message, and compares them with stored figures.
///
/// Needs valgrind. Exit code 1: a path has at least 3 % more instructions than stored.
#[derive(Parser)]
struct Arguments {
    /// Store the counted figures for this compiler, C library and profile
    #[arg(long)]
    store: bool,
    /// Count each path once, and keep callgrind's files in this directory, for callgrind_annotate
    #[arg(long, value_name = "DIRECTORY", conflicts_with = "store")]
    keep: Option<PathBuf>,
    /// Only the paths with all of these words in their names
    words: Vec<String>,
}

/// What is done with the counts.
enum Counting {
    Compare,
    Store,
    /// Callgrind's files are kept in this directory.
    Keep(PathBuf),
}

fn main() -> ExitCode {
    if let Some(role) = sinew_figures::process::role() {
        ends::play(&role);
        return ExitCode::SUCCESS;
    }
    let arguments = Arguments::parse();
    let is_wanted = |path: &Path| arguments.words.iter().all(|word| path.name().contains(word.as_str()));
    let wanted: Vec<_> = Path::ALL.into_iter().filter(is_wanted).collect();
    if wanted.is_empty() {
        let names = Path::ALL.map(Path::name).join(", ");
        eprintln!("no path has {} in its name; there are {names}", arguments.words.join(" and "));
        return ExitCode::from(2);
    }
    let counting = match (arguments.store, arguments.keep) {
        (true, _) => Counting::Store,
        (false, Some(directory)) => Counting::Keep(directory),
        (false, None) => Counting::Compare,
    };
    // With a CPU each, it would differ from run to run which thread or process wakes first.
    Pinning::OneCpu.pin(End::Measuring);
    match run(&wanted, &counting) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(why) => {
            eprintln!("{why}");
            ExitCode::from(2)
        }
    }
}

/// Counts the instructions of a path to be stored: the most of three counts. Which thread wakes first changes a count
/// by some percent, that of two threads by fifteen.
fn most(path: Path) -> Result<u64, String> {
    let counts = [path.instructions(None)?, path.instructions(None)?, path.instructions(None)?];
    Ok(counts.into_iter().fold(0, u64::max))
}

/// Counts the instructions of a path to be compared: the first count that has not grown, or the least of [`RUNS`].
fn least(path: Path, stored: Option<u64>) -> Result<u64, String> {
    let mut least = path.instructions(None)?;
    for _ in 1..RUNS {
        if Verdict::of(least, stored) != Verdict::Grown {
            break;
        }
        least = least.min(path.instructions(None)?);
    }
    Ok(least)
}

/// Counts and compares these paths. Returns whether none has grown.
fn run(wanted: &[Path], counting: &Counting) -> Result<bool, String> {
    let key = stored::key()?;
    let before = stored::read(&key)?;
    println!("{key}");
    let stores = matches!(counting, Counting::Store);
    if before.is_empty() && !stores {
        println!("nothing is stored for this compiler, C library and profile: nothing is compared");
    }
    println!("{:16} {:>12} {:>12} {:>8}", "path", "instructions", "stored", "change");
    let mut counted = before.clone();
    let mut is_well = true;
    for path in wanted {
        let stored = before.get(path.name()).copied();
        let count = match counting {
            Counting::Compare => least(*path, stored)?,
            Counting::Store => most(*path)?,
            Counting::Keep(directory) => path.instructions(Some(directory))?,
        };
        let verdict = Verdict::of(count, stored);
        is_well &= verdict != Verdict::Grown;
        let shown = stored.map_or_else(|| "-".to_owned(), |stored| stored.to_string());
        println!(
            "{:16} {count:>12} {shown:>12} {:>8} {}",
            path.name(),
            stored::change(count, stored),
            verdict.words()
        );
        counted.insert(path.name().to_owned(), count);
    }
    if stores {
        stored::write(&key, &counted)?;
        println!("stored: draw them with `cargo run -p sinew-charts`");
        return Ok(true);
    }
    Ok(is_well)
}

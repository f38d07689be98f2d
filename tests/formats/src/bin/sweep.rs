//! Runs randomly mutated known inputs through every byte format: a driver that needs no fuzzer.
//!
//! `cargo run --release -p sinew-formats --bin sweep -- --executions 100000`; `--help` lists the options.
//!
//! Exit code 1: a format has no input directory, or none of its inputs was understood, so that nothing was
//! tested. Exit code 101: an invariant is broken. The last lines name the file with the input; `--replay`
//! runs it again.

use std::{
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    process::ExitCode,
    time::Instant,
};

use clap::Parser;
use sinew_formats::{FORMATS, Format, mutate};

/// Maximum number of understood inputs that are kept for further mutation.
const KEPT: usize = 1_024;

/// Runs randomly mutated known inputs through every byte format.
#[derive(Parser)]
struct Arguments {
    /// The formats to run; all of them by default.
    formats: Vec<String>,
    /// Number of inputs per format.
    #[arg(long, default_value_t = 100_000)]
    executions: u64,
    /// Seed of all mutations.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The directory with one input directory per format.
    #[arg(long, default_value = "fuzz/corpus")]
    corpus: PathBuf,
    /// Writes the built-in seed inputs of each format into that directory, for libFuzzer, and runs nothing.
    #[arg(long)]
    write_seeds: bool,
    /// Replays this one input with the named format.
    #[arg(long)]
    replay: Option<PathBuf>,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Some(unknown) = arguments.formats.iter().find(|name| Format::named(name).is_none()) {
        let names = FORMATS.map(|format| format.name).join(", ");
        eprintln!("there is no format {unknown}; there are: {names}");
        return ExitCode::FAILURE;
    }
    let is_meant = |format: &Format| {
        arguments.formats.is_empty() || arguments.formats.iter().any(|name| name == format.name)
    };
    let formats = FORMATS.into_iter().filter(is_meant);
    let done = if arguments.write_seeds {
        formats.into_iter().try_for_each(|format| write_seeds(format, &arguments.corpus))
    } else if let Some(path) = &arguments.replay {
        std::fs::read(path).map(|input| {
            for format in formats {
                println!("{}: understood {}", format.name, (format.play)(&input));
            }
        })
    } else {
        formats.into_iter().try_fold(0, |all, format| sweep(format, &arguments).map(|count| all + count)).map(
            |all| {
                println!("{all} executions, nothing broken");
            },
        )
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// Returns the number of inputs that were run.
fn sweep(format: Format, arguments: &Arguments) -> std::io::Result<u64> {
    let mut random = fastrand::Rng::with_seed(arguments.seed);
    let inputs = format.inputs(&arguments.corpus)?;
    let (began, mut understood) = (Instant::now(), 0_u64);
    let mut kept: VecDeque<Vec<u8>> = inputs.iter().cloned().collect();
    for number in 0..arguments.executions {
        // Each known input first runs unchanged.
        let known = usize::try_from(number).ok().and_then(|at| inputs.get(at)).cloned();
        let input = known.unwrap_or_else(|| mutate(&mut random, kept.make_contiguous()));
        if play(format, &input)? {
            understood += 1;
            // An understood input is mutated further. If the list is full, it replaces another one.
            if kept.len() >= KEPT.max(inputs.len()) {
                let at = random.usize(0..kept.len());
                kept.swap_remove_back(at);
            }
            if random.u8(..) < 16 {
                kept.push_back(input);
            }
        }
    }
    let (count, seconds) = (arguments.executions, began.elapsed().as_secs_f64());
    println!(
        "{:<14} {count:>10} executions, {understood:>10} understood, {seconds:>7.1} s  ({})",
        format.name, format.from
    );
    if understood == 0 {
        return Err(std::io::Error::other(format!(
            "{}: none of {count} inputs was understood: it tried nothing; see that its seeds are of today's format",
            format.name
        )));
    }
    Ok(count)
}

/// Returns whether the input was understood.
fn play(format: Format, input: &[u8]) -> std::io::Result<bool> {
    match catch_unwind(AssertUnwindSafe(|| (format.play)(input))) {
        Ok(is_understood) => Ok(is_understood),
        Err(panic) => {
            let path = std::env::temp_dir().join(format!("sinew-{}-{:016x}", format.name, hash(input)));
            std::fs::write(&path, input)?;
            eprintln!(
                "{} breaks: `cargo run -p sinew-formats --bin sweep -- {} --replay {}`",
                format.name,
                format.name,
                path.display()
            );
            std::panic::resume_unwind(panic)
        }
    }
}

fn write_seeds(format: Format, corpus: &Path) -> std::io::Result<()> {
    let directory = corpus.join(format.name);
    std::fs::create_dir_all(&directory)?;
    for seed in format.seeds() {
        std::fs::write(directory.join(format!("seed-{:016x}", hash(&seed))), seed)?;
    }
    Ok(())
}

/// A file name for these bytes (FNV-1a, 64 bits).
fn hash(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

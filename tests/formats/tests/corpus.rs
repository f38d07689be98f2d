//! Replays every input of the corpus, and some mutations of each.

use std::path::Path;

use sinew_formats::{FORMATS, Format, mutate};

const CORPUS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus");
/// Number of mutated inputs per format: enough to show that the driver works. `sweep` runs more, the fuzzer
/// most.
const CHANGED: usize = 2_000;

#[test]
fn corpus_is_replayed_and_seeds_are_understood() {
    for format in FORMATS {
        let inputs = format.inputs(Path::new(CORPUS)).expect("the source tree can be read");
        let mut understood = 0;
        for input in &inputs {
            understood += usize::from((format.play)(input));
        }
        assert!(
            understood > 0,
            "{}: none of {} inputs is understood: it tries nothing",
            format.name,
            inputs.len()
        );
        for seed in format.seeds() {
            assert!(
                (format.play)(&seed),
                "{}: {:?} is not understood",
                format.name,
                String::from_utf8_lossy(&seed)
            );
        }
    }
}

#[test]
fn mutated_inputs_break_no_invariant() {
    for format in FORMATS {
        let inputs = format.inputs(Path::new(CORPUS)).expect("the source tree can be read");
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..CHANGED {
            (format.play)(&mutate(&mut random, &inputs));
        }
    }
}

#[test]
fn every_format_has_a_fuzz_target() {
    let fuzz = Path::new(CORPUS).parent().expect("it is a directory of `fuzz`").to_owned();
    let manifest = std::fs::read_to_string(fuzz.join("Cargo.toml")).expect("the source tree can be read");
    for Format { name, .. } in FORMATS {
        assert!(manifest.contains(&format!("name = \"{name}\"")), "fuzz/Cargo.toml has no target {name}");
        let target = std::fs::read_to_string(fuzz.join(format!("fuzz_targets/{name}.rs")));
        assert!(
            target.is_ok_and(|text| text.contains(&format!("\"{name}\""))),
            "the target {name} plays another format"
        );
    }
}

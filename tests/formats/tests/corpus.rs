//! Every input that is kept, and some changes of each.

use std::path::Path;

use sinew_formats::{FORMATS, Format, mutate};

const CORPUS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus");
/// Changed inputs of each format: enough to see that the driver works. `sweep` plays more, and the fuzzer most.
const CHANGED: usize = 2_000;

#[test]
fn every_input_that_is_kept_is_played_and_what_the_other_side_writes_is_understood() {
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
fn changed_inputs_break_no_promise() {
    for format in FORMATS {
        let inputs = format.inputs(Path::new(CORPUS)).expect("the source tree can be read");
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..CHANGED {
            (format.play)(&mutate(&mut random, &inputs));
        }
    }
}

#[test]
fn every_format_has_a_target_for_the_fuzzer() {
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

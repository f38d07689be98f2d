//! Hostile clients, in short: the long form is the program `hostile_client`.

use std::time::Duration;

use sinew_tests::{
    clients::{
        Kernel,
        hostile::{Plan, run},
    },
    program,
};

fn attack(kernel: Kernel) {
    let seed = u64::from(std::process::id());
    let lasts = Duration::from_secs(5);
    // A deadline and no limit of speed, on a machine that others share: the long form allows one second.
    let held_up_max = Duration::from_secs(10);
    let report = run(Plan { program: program("hostile_client"), lasts, seed, kernel, held_up_max });
    println!("{report}");
    assert!(report.holds(), "replay with `--bin hostile_client -- --seed {seed}`, on {kernel}:\n{report}");
}

#[test]
fn a_node_lives_within_its_bounds_and_serves_the_others_whatever_a_client_does() {
    attack(Kernel::Present);
}

#[test]
fn so_it_does_where_the_kernel_cannot_refuse_descriptors() {
    attack(Kernel::WithoutPassRights);
}

//! Hostile clients, in short: the long form is the program `hostile_client`.

use std::time::Duration;

use sinew_tests::clients::{
    Kernel,
    hostile::{Plan, run},
};

fn attack(kernel: Kernel) {
    let seed = u64::from(std::process::id());
    let lasts = Duration::from_secs(5);
    // A deadline and not a speed limit, because the machine is shared. The long form allows one second.
    let held_up_max = Duration::from_secs(10);
    let report = run(Plan { lasts, seed, kernel, held_up_max });
    println!("{report}");
    assert!(report.holds(), "replay with `hostile_client --seed {seed}`, on {kernel}:\n{report}");
}

#[test]
fn hostile_client_harms_neither_node_nor_others() {
    attack(Kernel::Present);
}

#[test]
fn hostile_client_is_harmless_without_kernel_fd_rejection() {
    attack(Kernel::WithoutPassRights);
}

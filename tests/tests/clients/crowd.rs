//! Who takes all that one process may have leaves the others their places.

use sinew::{NodeApi, Registration};
use sinew_tests::{
    Log,
    clients::{Performer, Stage, StageLimits},
    program,
};

/// Of which one process may have a quarter.
const CLIENTS: usize = 12;

fn crowd(stage: &Stage) -> (Performer, Log<String>) {
    let says: Log<String> = Log::default();
    let heard = says.clone();
    let performer = stage.start("crowd", &[], move |line| heard.write(line.to_owned()));
    says.wait("it has all that it can have", |lines| {
        lines.iter().any(|line| line.starts_with("silent")).then_some(())
    });
    (performer, says)
}

#[test]
fn a_process_that_takes_every_place_that_it_can_have_keeps_nobody_else_out() {
    // Given: a node, and a process that registers until it is refused, and has connections besides that say nothing.
    let limits = StageLimits { mailbox_capacity: 16, payload_max: 4_096, clients_max: CLIENTS };
    let stage = Stage::new(&program("client_kills"), limits);
    let (first, says) = crowd(&stage);
    assert!(says.all().contains(&format!("has {}", CLIENTS / 4)), "{:?}", says.all());
    let refused = says.all().into_iter().find(|line| line.starts_with("refused")).expect("it was refused");
    assert!(refused.contains("`lncl.clients_per_process_max`"), "{refused}");

    // When: another one registers, while the silent ones have their time.
    let api = NodeApi::connect(stage.socket()).expect("the door is open");
    let endpoint = api.register_transport_address(Registration::new());

    // Then: it has its place; and so has a second crowd.
    assert!(endpoint.is_ok(), "{endpoint:?}");
    let (second, says) = crowd(&stage);
    assert!(says.all().contains(&format!("has {}", CLIENTS / 4)), "{:?}", says.all());
    drop(endpoint);
    assert!(first.end().success() && second.end().success());
    stage.end();
}

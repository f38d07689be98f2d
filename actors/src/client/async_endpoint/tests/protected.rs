//! Protected payloads from task to task.

use serde::{Deserialize, Serialize};
use sinew_runtime::{protection::Protection, time::Time};

use super::{Duration, Payload, TestNode, Transport, WATCHDOG, endpoint, runtime, timeout};

const LOOK: Duration = Duration::from_millis(1);

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Speed(u64);

impl Payload for Speed {
    const NAME: &'static str = "test.speed";
    // Nothing is late on a machine that is busy.
    const PROTECTION: Option<Protection> = Some(Protection::of_period(WATCHDOG));
}

#[test]
fn commands_come_through_the_guard_of_a_task_when_it_is_armed_and_no_sooner() {
    let node = TestNode::start();
    runtime().block_on(async {
        let mut control = endpoint(&node, Transport::Ring).await;
        let mut drive = endpoint(&node, Transport::Ring).await;
        // Sealed: whoever has no guard cannot read it.
        control.send(drive.tid(), &Speed(0)).await.unwrap();
        let sealed =
            timeout(WATCHDOG, drive.receive()).await.expect("the first command, which is for nobody's guard");
        assert!(sealed.unwrap().decode::<Speed>().is_err());
        let guard = drive.guard::<Speed, _>(control.tid(), 1_u64, |speed, _| *speed = 0).unwrap();
        let deadline = Time::now() + WATCHDOG;
        let (mut sent, mut is_armed) = (0, false);
        let received = loop {
            assert!(Time::now() < deadline, "{:?}", guard.tally());
            // Says what is to be quoted, and gets what came.
            if let Ok(received) = timeout(LOOK, drive.receive()).await {
                // Whatever was under way when it was armed.
                assert!(is_armed, "nothing comes through before that");
                break received.unwrap();
            }
            is_armed |= guard.arm().is_ok();
            assert!(timeout(LOOK, control.receive()).await.is_err(), "an echo is not for the program");
            sent += 1;
            control.send(drive.tid(), &Speed(sent)).await.unwrap();
        };
        let speed = received.decode::<Speed>().unwrap();
        assert_eq!(guard.apply(|output| std::mem::replace(output, speed.0)), Ok(0));
    });
}

//! Protected payloads from task to task.

use serde::{Deserialize, Serialize};
use sinew_runtime::{protection::Protection, time::Time};

use super::{Duration, Payload, TestNode, Transport, WATCHDOG, endpoint, runtime, timeout};

const POLL_INTERVAL: Duration = Duration::from_millis(1);

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Speed(u64);

impl Payload for Speed {
    const NAME: &'static str = "test.speed";
    // Nothing is late on a machine that is busy.
    const PROTECTION: Option<Protection> = Some(Protection::of_period(WATCHDOG));
}

#[test]
fn commands_pass_guard_of_task_only_once_armed() {
    let node = TestNode::start();
    runtime().block_on(async {
        let mut control = endpoint(&node, Transport::Ring).await;
        let mut drive = endpoint(&node, Transport::Ring).await;
        // Sealed: an endpoint without a guard cannot read it.
        control.send(drive.tid(), &Speed(0)).await.unwrap();
        let sealed =
            timeout(WATCHDOG, drive.receive()).await.expect("the first command, which no guard takes");
        assert!(sealed.unwrap().decode::<Speed>().is_err());
        let guard = drive.guard::<Speed, _>(control.tid(), 1_u64, |speed, _| *speed = 0).unwrap();
        let deadline = Time::now() + WATCHDOG;
        let (mut sent, mut is_armed) = (0, false);
        let received = loop {
            assert!(Time::now() < deadline, "{:?}", guard.tally());
            // Sends the echo, and receives messages.
            if let Ok(received) = timeout(POLL_INTERVAL, drive.receive()).await {
                // The message may have been in flight when the guard was armed.
                assert!(is_armed, "nothing comes through before that");
                break received.unwrap();
            }
            is_armed |= guard.arm().is_ok();
            assert!(
                timeout(POLL_INTERVAL, control.receive()).await.is_err(),
                "an echo is not for the program"
            );
            sent += 1;
            control.send(drive.tid(), &Speed(sent)).await.unwrap();
        };
        let speed = received.decode::<Speed>().unwrap();
        assert_eq!(guard.apply(|output| std::mem::replace(output, speed.0)), Ok(0));
    });
}

//! What crosses an edge between applications: classes and names of the messages, names of applications and groups.

use serde::{Deserialize, Serialize};
use sinew::prelude::{Actor, AppContext, Class, Delivery, Duration, Payload, Tid, Time, payload};
use sinew::protection::Protection;

use crate::joint::Joint;
use crate::message::{DriveStatus, FootLoad, GaitMode, GaitState, JointSample, TorqueSet};

/// A start that waits for other parts of the robot is no fault, however long it takes.
pub(super) const AS_LONG_AS_IT_TAKES: Duration = Duration::from_secs(7 * 24 * 3600);

/// Name of the application that estimates the phase.
pub const GAIT: &str = "central.gait";
/// Group of those who stop when the e-stop is pressed: the drives and central's gait.
pub const STOP: &str = "exo.stop";
/// Group of those who want to know how things stand.
pub const STATUS: &str = "exo.status";

/// Time between two looks at the directory, ns.
const LOOK_PERIOD_NS: u128 = 100_000_000;

impl Payload for JointSample {
    const NAME: &'static str = "exo.joint_sample";
    const CLASS: Class = Class::Stream;
}

impl Payload for FootLoad {
    const NAME: &'static str = "exo.foot_load";
    const CLASS: Class = Class::Stream;
}

impl Payload for GaitState {
    const NAME: &'static str = "exo.gait_state";
    const CLASS: Class = Class::Stream;
    /// Torque comes of it, so it is protected from central's gait to each drive. A drive uses a word for 10 ms, as the one
    /// that replaces it may be late or lost; central quotes a drive's clock that is at most an echo's period, the way and
    /// its own millisecond old.
    const PROTECTION: Option<Protection> = Some(Protection {
        within: Duration::from_millis(10),
        age_max: Duration::from_millis(60),
        lost_max: 9,
        bad_max: 1,
        good_min: 8,
    });
}

/// Not protected from end to end, and on the way to torque for all that: a guard knows one sender, and this comes from whichever application on
/// central's node sends it. So its bound stands at the drive and not at the sender: [`DriveCore::command`](crate::control::drive::DriveCore::command)
/// refuses one that is further than 10 Nm (`command_apart_max_nm`) from what the drive feeds forward itself, and each tick keeps the newest one
/// within that again, as the phase goes on. It counts for 10 ms (`input_age_max_ns`), in WALK alone, which takes the open guard of [`GaitState`], below
/// the limits of the joint's torque and of its rate. A sender that is not central's node is rejected. So one that is damaged or forged past
/// the node's checksum, TLS and access list moves a joint by 10 Nm at most from its own moment, and cannot make a drive assist that does not. See README.md,
/// "Safety states".
impl Payload for TorqueSet {
    const NAME: &'static str = "exo.torque_set";
    const CLASS: Class = Class::Stream;
}

impl Payload for DriveStatus {
    const NAME: &'static str = "exo.drive_status";
    const CLASS: Class = Class::Stream;
}

payload!("exo.release" =>
    /// From the coordinator or the operator to central's gait: the person may walk. Refused while the e-stop is latched.
    #[derive(Debug, Clone, Copy)]
    pub struct Release {}
);

payload!("exo.emergency_stop" =>
    /// From anybody to the group `exo.stop`: torque to zero, and stay there. Software, not a safety function.
    #[derive(Debug, Clone, Copy)]
    pub struct EmergencyStop {}
);

payload!("exo.reset" =>
    /// From the operator to central's gait, then to each drive: the e-stop is taken back. A drive refuses it while its
    /// torque is not zero and while central says stop.
    #[derive(Debug, Clone, Copy)]
    pub struct Reset {}
);

payload!("exo.shut", Stream =>
    /// From a drive to central's gait, 200 times a second while it is so: your word does not count here, though it comes.
    #[derive(Debug, Clone, Copy)]
    pub struct Shut {
        /// Whether words came that were damaged, or not central's at all, since the last good stretch: 64 good ones through an open guard.
        /// Whatever the guard was shut for.
        pub suspect: bool,
    }
);

/// From central's gait to a drive, as an answer to [`Shut`]: let my word count again. A drive never does that by itself.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Arm {
    /// What [`Shut::suspect`] said. A drive that has become suspicious since then refuses.
    pub suspect: bool,
}

impl Payload for Arm {
    const NAME: &'static str = "exo.arm";
    const CLASS: Class = Class::Stream;
    /// A torque may come of it, so it is protected like [`GaitState`]. A drive asks five times in `within`; the first answer begins the
    /// count, the second one is counted. One that is lost is asked for again, so many may be.
    const PROTECTION: Option<Protection> = Some(Protection {
        within: Duration::from_millis(25),
        age_max: Duration::from_millis(40),
        lost_max: 9,
        bad_max: 1,
        good_min: 1,
    });
}

payload!("exo.gait_status", Stream =>
    /// From central to the group `exo.status`, 20 times a second.
    #[derive(Debug, Clone, Copy)]
    pub struct GaitStatus {
        /// Estimated phase, cycles 0..1.
        pub phase: f32,
        /// Trust in the phase, 0..1.
        pub confidence: f32,
        /// What the drives are asked to do; none while a part was never heard.
        pub mode: Option<GaitMode>,
        /// Joints whose drives do not help; bit 0 hip, bit 1 knee, bit 2 ankle.
        pub degraded: u8,
        /// Greatest lateness of a tick since the last status, us.
        pub late_max_us: u32,
    }
);

payload!("exo.barrier_status", Stream =>
    /// From each node to the group `exo.status`, 10 times a second: who of its applications waits for whom.
    #[derive(Debug, Clone)]
    pub struct BarrierStatus {
        /// A sentence for each application that waits.
        pub waiting: Vec<String>,
    }
);

/// When a message was sent, ns of this host's clock, and how much earlier that may have been. Where that is not known it is `t_ns`, by
/// the clock of its sender, and `None`.
pub(super) fn sent<P>(message: &Delivery<P>, t_ns: u64) -> (u64, Option<u64>) {
    let error_ns = message.age_error().map(|error| u64::try_from(error.as_nanos()).unwrap_or(u64::MAX));
    (message.sent.map_or(t_ns, Time::as_nanos), error_ns)
}

/// Name of a joint's sensor.
#[must_use]
pub fn sensor_name(joint: Joint) -> String {
    format!("{joint}.sensor")
}

/// Name of a joint's drive.
#[must_use]
pub fn drive_name(joint: Joint) -> String {
    format!("{joint}.drive")
}

/// The joint whose sensor has this name.
#[must_use]
pub fn joint_of_sensor(name: &str) -> Option<Joint> {
    Joint::ALL.into_iter().find(|joint| name.strip_suffix(".sensor") == Some(joint.name()))
}

/// Somebody who is sent to a thousand times a second: the directory is asked ten times a second.
#[derive(Debug)]
pub(super) struct Addressee {
    name: String,
    tid: Option<Tid>,
    looked_at: Option<Time>,
}

impl Addressee {
    pub(super) const fn new(name: String) -> Self {
        Self { name, tid: None, looked_at: None }
    }

    /// Where it is now; `None` while nobody has the name.
    pub(super) fn at<A>(&mut self, now: Time, context: &AppContext<A>) -> Option<Tid>
    where
        A: Actor<Context = AppContext<A>>,
    {
        if self.looked_at.is_none_or(|at| now.since(at).as_nanos() >= LOOK_PERIOD_NS) {
            self.looked_at = Some(now);
            self.tid = context.resolve(&self.name);
        }
        self.tid
    }
}

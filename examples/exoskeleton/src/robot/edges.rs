//! The messages between applications that no core knows, and the names of applications and groups. The
//! messages between the cores are in [`exoskeleton_model::message`].

use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveStatus, DriveTick, FootLoad, GaitMode, GaitState, JointSample};
use exoskeleton_recording::recorder::KnownNames;
use serde::{Deserialize, Serialize};
use sinew::message::Kind;
use sinew::parameters::{ParameterOutcome, SetParameters};
use sinew::prelude::{Actor, AppContext, Class, Delivery, Duration, Payload, Tid, Time, payload};
use sinew::protection::Protection;

/// Limit for a start that waits for other parts of the robot: that is no fault, however long it takes.
pub(super) const AS_LONG_AS_IT_TAKES: Duration = Duration::from_secs(7 * 24 * 3600);

/// Name of the application that estimates the phase.
pub const GAIT: &str = "central.gait";
/// Group of the applications that stop at an e-stop: the drives and central's gait.
pub const STOP: &str = "exo.stop";
/// Group of the receivers of statuses.
pub const STATUS: &str = "exo.status";
/// Group of the drives' ticks. It has no members: recordings have its messages.
pub const TICKS: &str = "exo.ticks";

/// Time between two lookups in the directory, ns.
const LOOK_PERIOD_NS: u128 = 100_000_000;

payload!("exo.release" =>
    /// From the coordinator or the operator to central's gait: the person may walk. Rejected while the e-stop
    /// is latched.
    #[derive(Debug, Clone, Copy)]
    pub struct Release {}
);

payload!("exo.emergency_stop" =>
    /// From any sender to the group `exo.stop`: ramp the torque to zero and keep it there. Software, not a
    /// safety function.
    #[derive(Debug, Clone, Copy)]
    pub struct EmergencyStop {}
);

payload!("exo.reset" =>
    /// From the operator to central's gait, then to each drive: reset the e-stop. A drive rejects it while
    /// its torque is not zero and while central commands stop.
    #[derive(Debug, Clone, Copy)]
    pub struct Reset {}
);

payload!("exo.shut", Stream =>
    /// From a drive to central's gait, 200 times a second while it holds: your commands arrive, but do not
    /// count.
    #[derive(Debug, Clone, Copy)]
    pub struct Shut {
        /// Whether commands arrived that were damaged, or not from central, since the last good stretch: 64
        /// good ones through an open guard. Independent of the reason of the shut guard.
        pub suspect: bool,
    }
);

/// From central's gait to a drive, as an answer to [`Shut`]: accept my commands again. A drive never does so
/// by itself.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Arm {
    /// The value of [`Shut::suspect`]. A drive that has become suspicious since then rejects this.
    pub suspect: bool,
}

impl Payload for Arm {
    const NAME: &'static str = "exo.arm";
    const CLASS: Class = Class::Stream;
    /// It may cause a torque, so it is protected like `GaitState`. A drive requests it five times in `within`;
    /// the first answer starts the count, the second one is counted. A lost one is requested again, so many
    /// may be lost.
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
        /// The command for the drives; none while a part was never received.
        pub mode: Option<GaitMode>,
        /// Joints with drives that do not assist; bit 0 hip, bit 1 knee, bit 2 ankle.
        pub degraded: u8,
        /// Maximum lateness of a tick since the last status, us.
        pub late_max_us: u32,
    }
);

payload!("exo.barrier_status", Stream =>
    /// From each node to the group `exo.status`, 10 times a second: its applications that wait, and for which
    /// others.
    #[derive(Debug, Clone)]
    pub struct BarrierStatus {
        /// A sentence for each application that waits.
        pub waiting: Vec<String>,
    }
);

/// Returns the names that the topics of a recording have.
#[must_use]
pub fn names() -> KnownNames {
    let apps = Joint::ALL.into_iter().flat_map(|joint| [sensor_name(joint), drive_name(joint)]);
    let types = vec![
        named::<Arm>(),
        named::<BarrierStatus>(),
        named::<DriveStatus>(),
        named::<DriveTick>(),
        named::<FootLoad>(),
        named::<GaitState>(),
        named::<GaitStatus>(),
        named::<JointSample>(),
        named::<ParameterOutcome>(),
        named::<Release>(),
        named::<SetParameters>(),
        named::<Shut>(),
    ];
    KnownNames { apps: apps.chain([GAIT.to_owned()]).collect(), groups: vec![STATUS, STOP, TICKS], types }
}

const fn named<P: Payload>() -> (Kind, &'static str) {
    (P::KIND, P::NAME)
}

/// Returns the time of sending, ns of this host's clock, and its maximum error toward earlier. If that is not
/// known: `t_ns`, in the clock of its sender, and `None`.
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

/// The joint with a sensor of this name.
#[must_use]
pub fn joint_of_sensor(name: &str) -> Option<Joint> {
    Joint::ALL.into_iter().find(|joint| name.strip_suffix(".sensor") == Some(joint.name()))
}

/// A receiver that gets a thousand messages a second; its address is looked up in the directory ten times a
/// second.
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

    /// Returns its present address; `None` while no application has the name.
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

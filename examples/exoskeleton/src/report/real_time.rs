//! Figures that only a run in real time has.

use std::collections::BTreeMap;

use exoskeleton_model::joint::PerJoint;
use exoskeleton_model::record::Stall;
use serde::Serialize;

/// Percentiles of a time, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PercentilesUs {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Greatest.
    pub max: f64,
}

/// Timing of the drives' loops.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LoopSummary {
    /// Ticks.
    pub ticks: u64,
    /// Time between ticks.
    pub period_us: PercentilesUs,
    /// Lateness of the ticks.
    pub lateness_us: PercentilesUs,
    /// Age of the joint sample used while walking: from its sensor's reading to the drive's tick.
    pub sample_age_us: PercentilesUs,
    /// Age of the gait state used while walking: from central's tick to the drive's.
    pub gait_age_us: PercentilesUs,
    /// Turns that did not come within 2 ms of their time.
    pub deadline_misses: u64,
}

/// Figures of real-time runs only.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RealTimeFigures {
    /// The drives' loops, all three together, from the first readiness to the last stride.
    pub drives: LoopSummary,
    /// Lateness of central's loop, us.
    pub central_late_us: PercentilesUs,
    /// Lateness of the plant's loop, us.
    pub plant_late_us: PercentilesUs,
    /// CPU time of each process while walking, per cent of one CPU.
    pub cpu_percent: BTreeMap<String, f64>,
    /// All of them, per cent of one CPU.
    pub cpu_percent_total: f64,
    /// The witness's observations of the host.
    pub host: HostFigures,
    /// The figures of undisturbed strides only; `null` if the host did not stall.
    pub without_stalls: Option<UnstalledFigures>,
    /// Detection of the death of a node, if one was killed.
    pub kill: Option<KillFigures>,
}

/// The witness's observations of the host: threads of the launcher that only sleep, one on each CPU.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HostFigures {
    /// CPUs with a witness.
    pub witnesses: usize,
    /// Number of times that the witnesses were woken.
    pub wakes: u64,
    /// Wakes that were more than 2 ms late: the deadline of a drive's tick.
    pub deadline_misses: u64,
    /// Stalls of the host, in which a witness was at least 5 ms late: seconds of the run. The strides around
    /// them are counted separately.
    pub stalls: Vec<Stall>,
    /// Stalls that the robot has caused itself, by its use of CPU time. Their strides count.
    pub own_stalls: Vec<Stall>,
    /// Strides that are counted separately, the first stride being 1.
    pub strides_disturbed: Vec<u32>,
    /// CPU time of all other programs while walking, per cent of all CPUs.
    pub others_cpu_percent: Option<f64>,
    /// CPU time that a hypervisor reports to have taken while walking, per cent of all CPUs.
    pub stolen_cpu_percent: Option<f64>,
}

/// Detection of the death of a node: times since the kill, ms; `null` if it was not detected.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct KillFigures {
    /// Until each other drive damped.
    pub safe_after_ms: BTreeMap<String, Option<f64>>,
    /// Until each other node's discovery reported `NodeLost`.
    pub node_lost_after_ms: BTreeMap<String, Option<f64>>,
}

/// The walk outside the stalls of the host.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UnstalledFigures {
    /// RMS against the reference, degrees: hip, knee, ankle.
    pub rms_deg: PerJoint<f64>,
    /// RMS of the phase error, per cent.
    pub phase_rms_percent: f64,
}

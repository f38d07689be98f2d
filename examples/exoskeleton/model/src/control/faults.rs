//! The faults that a drive counts and reports about its inputs and outputs.

/// Bits of `DriveStatus::faults`; a bit stays set until the drive is reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FaultBits(pub u16);

impl FaultBits {
    /// A joint sample was rejected.
    pub const SAMPLE_REFUSED: Self = Self(1);
    /// A gait state was rejected.
    pub const GAIT_REFUSED: Self = Self(1 << 1);
    /// Inputs were lost while walking.
    pub const INPUT_LOST: Self = Self(1 << 2);
    /// The torque law reached the torque limit.
    pub const SATURATED: Self = Self(1 << 3);
    /// The e-stop was pressed.
    pub const STOPPED: Self = Self(1 << 4);
    /// A torque set from outside was rejected.
    pub const COMMAND_REFUSED: Self = Self(1 << 5);

    /// Sets the bits of `other`, too.
    pub const fn insert(&mut self, other: Self) {
        self.0 |= other.0;
    }

    /// Whether all bits of `other` are set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// Rejected inputs by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RefusedCount {
    /// A value was NaN or infinite.
    pub not_finite: u32,
    /// A value no leg can have.
    pub out_of_range: u32,
    /// Sequence number before or far after the one expected, or an epoch that is over.
    pub old_sequence: u32,
    /// Created longer ago than the age limit, or perhaps: its age is not known well enough.
    pub too_old: u32,
    /// Stamped later than now: clocks disagree.
    pub from_future: u32,
    /// Opposite to the required direction at this phase.
    pub opposed: u32,
}

impl RefusedCount {
    /// All rejections together.
    #[must_use]
    pub const fn total(&self) -> u32 {
        self.not_finite
            + self.out_of_range
            + self.old_sequence
            + self.too_old
            + self.from_future
            + self.opposed
    }
}

/// Counters of one drive since its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DriveCounters {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks in which a needed input was missing or over the age limit.
    pub misses: u32,
    /// Ticks in which the torque law reached the limit.
    pub saturated: u32,
    /// Number of times that the drive went from `Walk` to `Safe`.
    pub safe_entries: u32,
    /// Rejected joint samples.
    pub samples_refused: RefusedCount,
    /// Rejected gait states.
    pub gait_refused: RefusedCount,
    /// Torques from outside that were admitted.
    pub commands_admitted: u32,
    /// Rejected torques from outside.
    pub commands_refused: RefusedCount,
    /// Pauses after which the drive read its device's torque again.
    pub pauses: u32,
}

//! The recorded inputs of the drives: the newest ones of each.

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use exoskeleton_model::message::{DriveTick, GaitState, JointSample, UsedInput};
use serde::de::DeserializeOwned;
use sinew::protection::{DataId, open};
use sinew::{Payload, Tid};
use sinew_bag::read::{Channel, OwnedMessage, Role};

/// Maximum number of inputs of one kind that are kept for a drive: those of two seconds.
const KEPT_MAX: usize = 2_048;
/// Maximum number of receivers: three drives and central in some incarnations. Inputs of further ones are not kept.
const RECEIVERS_MAX: usize = 1_024;

/// The newest inputs of all drives.
#[derive(Debug, Default)]
pub(super) struct Inputs {
    /// The content of each channel; `None`: neither inputs nor ticks of a drive.
    routes: BTreeMap<u16, Option<Route>>,
    drives: BTreeMap<Tid, DriveInputs>,
}

/// The newest inputs of one drive.
#[derive(Debug, Default)]
pub(super) struct DriveInputs {
    pub(super) samples: VecDeque<JointSample>,
    pub(super) gaits: VecDeque<GaitState>,
}

/// The messages of a channel.
#[derive(Debug, Clone, Copy)]
struct Route {
    kind: RouteKind,
    source: Tid,
    destination: Tid,
}

#[derive(Debug, Clone, Copy)]
enum RouteKind {
    Tick,
    Sample,
    Gait,
}

impl Inputs {
    /// Keeps an input, or returns a tick and the address of its drive.
    pub(super) fn take(&mut self, message: &OwnedMessage) -> Option<(Tid, DriveTick)> {
        let route = *self.routes.entry(message.channel.id).or_insert_with(|| route(&message.channel));
        let Route { kind, source, destination } = route?;
        match kind {
            RouteKind::Tick => return Some((source, decode(&message.data)?)),
            RouteKind::Sample => {
                if let Some(sample) = decode(&message.data)
                    && let Some(inputs) = self.keep(destination)
                {
                    inputs.keep_sample(sample);
                }
            }
            RouteKind::Gait => {
                if let Some(inputs) = self.keep(destination) {
                    inputs.keep_gait((source, destination), &Bytes::copy_from_slice(&message.data));
                }
            }
        }
        None
    }

    /// Returns the inputs of a drive.
    pub(super) fn of(&self, drive: Tid) -> Option<&DriveInputs> {
        self.drives.get(&drive)
    }

    fn keep(&mut self, drive: Tid) -> Option<&mut DriveInputs> {
        if self.drives.len() >= RECEIVERS_MAX && !self.drives.contains_key(&drive) {
            return None;
        }
        Some(self.drives.entry(drive).or_default())
    }
}

impl DriveInputs {
    /// Keeps a joint sample.
    pub(super) fn keep_sample(&mut self, sample: JointSample) {
        push(&mut self.samples, sample);
    }

    /// Keeps a gait state, from its source to its destination in the envelope of its protection. One that cannot be
    /// read is missing.
    pub(super) fn keep_gait(&mut self, (source, destination): (Tid, Tid), sealed: &Bytes) {
        let opened = open(&DataId::of::<GaitState>(source, destination), sealed);
        if let Some(gait) = opened.and_then(|(_, payload)| decode(&payload)) {
            push(&mut self.gaits, gait);
        }
    }

    /// Returns the sample that a tick has used, as the drive has judged its time.
    pub(super) fn sample(&self, used: &UsedInput) -> Option<JointSample> {
        let found = self.samples.iter().rev().find(|sample| sample.seq == used.seq)?;
        Some(JointSample { t_ns: used.t_ns, t_error_ns: used.t_error_ns, ..*found })
    }

    /// Returns the gait state that a tick has used, as the drive has judged its time.
    pub(super) fn gait(&self, used: &UsedInput) -> Option<GaitState> {
        let is_it = |gait: &&GaitState| (gait.epoch, gait.seq) == (used.epoch, used.seq);
        let found = self.gaits.iter().rev().find(is_it)?;
        Some(GaitState { t_ns: used.t_ns, t_error_ns: used.t_error_ns, ..*found })
    }
}

fn push<T>(all: &mut VecDeque<T>, one: T) {
    if all.len() >= KEPT_MAX {
        all.pop_front();
    }
    all.push_back(one);
}

/// Returns the content of a channel with payloads that were received.
fn route(channel: &Channel) -> Option<Route> {
    if channel.role() != Role::Raw || !channel.value("refused").is_empty() {
        return None;
    }
    let number: u32 = channel.value("kind").parse().ok()?;
    let kinds = [
        (DriveTick::KIND, RouteKind::Tick),
        (JointSample::KIND, RouteKind::Sample),
        (GaitState::KIND, RouteKind::Gait),
    ];
    let (_, kind) = kinds.into_iter().find(|(kind, _)| kind.bits() == number)?;
    let tid = |key: &str| channel.value(key).parse().ok().map(Tid::from_bits);
    Some(Route { kind, source: tid("source_tid")?, destination: tid("destination_tid")? })
}

/// Decodes a payload; one that cannot be read is missing.
fn decode<P: DeserializeOwned>(bytes: &[u8]) -> Option<P> {
    rmp_serde::from_slice(bytes).ok()
}

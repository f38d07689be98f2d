//! The payload types of the applications of this node.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
};

use sinew_model::facts::{DeclaredTypes, TypeHash};
use sinew_runtime::{
    lock,
    tid::AppAddress,
    wire::{Kind, PayloadType},
};

/// Maximum number of types that one application handles, and of those that it sends; the directory has as many.
/// Further ones are not compared.
const TYPES_MAX: usize = 64;
/// Prefix of the names of Sinew's own types. Layers send and handle them, and keep them compatible.
const OWN_PREFIX: &str = "sinew.";

/// The types of all applications, and the applications with types that the directory does not have yet.
#[derive(Debug, Default)]
pub(super) struct Declared(Mutex<Table>);

#[derive(Debug, Default)]
struct Table {
    apps: BTreeMap<AppAddress, AppTypes>,
    changed: BTreeSet<AppAddress>,
}

/// The types of one application.
#[derive(Clone, Debug, Default)]
pub(super) struct AppTypes {
    handles: Vec<PayloadType>,
    sends: Vec<PayloadType>,
}

impl Declared {
    /// Records the declaration of a registered application. It replaces that of a former owner of the address.
    pub(super) fn register(&self, app: AppAddress, handles: &[PayloadType], sends: &[PayloadType]) {
        let mut types = AppTypes::default();
        handles.iter().for_each(|one| _ = add(&mut types.handles, *one));
        sends.iter().for_each(|one| _ = add(&mut types.sends, *one));
        let mut table = lock(&self.0);
        table.apps.insert(app, types);
        table.changed.insert(app);
    }

    /// Records that the application sends a type. Returns whether that is new. An application without a registration
    /// is ignored.
    pub(super) fn sends(&self, app: AppAddress, sent: PayloadType) -> bool {
        let mut table = lock(&self.0);
        let is_new = table.apps.get_mut(&app).is_some_and(|types| add(&mut types.sends, sent));
        if is_new {
            table.changed.insert(app);
        }
        is_new
    }

    /// Returns the applications with changes since the last call.
    pub(super) fn take_changed(&self) -> Vec<(AppAddress, AppTypes)> {
        let mut table = lock(&self.0);
        let changed = std::mem::take(&mut table.changed);
        changed.into_iter().filter_map(|app| Some((app, table.apps.get(&app)?.clone()))).collect()
    }

    /// Removes an application that is not registered.
    pub(super) fn forget(&self, app: AppAddress) {
        let mut table = lock(&self.0);
        table.apps.remove(&app);
        table.changed.remove(&app);
    }

    /// Returns the type of this kind that the application handles.
    pub(super) fn handled(&self, app: AppAddress, kind: Kind) -> Option<PayloadType> {
        of_kind(&lock(&self.0).apps.get(&app)?.handles, kind)
    }

    /// Returns the type of this kind that the application sends.
    pub(super) fn sent(&self, app: AppAddress, kind: Kind) -> Option<PayloadType> {
        of_kind(&lock(&self.0).apps.get(&app)?.sends, kind)
    }
}

impl AppTypes {
    /// Traces the types. It may take milliseconds for each, at the first time.
    pub(super) fn hashes(&self) -> DeclaredTypes {
        let hash = |one: &PayloadType| -> Option<TypeHash> { Some((one.kind(), one.schema().ok()?.hash())) };
        DeclaredTypes {
            handles: self.handles.iter().filter_map(hash).collect(),
            sends: self.sends.iter().filter_map(hash).collect(),
        }
    }
}

/// Adds a type unless one of its kind is there. Returns whether it was added.
fn add(types: &mut Vec<PayloadType>, one: PayloadType) -> bool {
    let is_compared = !one.name().starts_with(OWN_PREFIX);
    let is_new = is_compared && types.len() < TYPES_MAX && of_kind(types, one.kind()).is_none();
    if is_new {
        types.push(one);
    }
    is_new
}

fn of_kind(types: &[PayloadType], kind: Kind) -> Option<PayloadType> {
    types.iter().copied().find(|one| one.kind() == kind)
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};
    use sinew_runtime::{
        app::{AppContext, AppSpec, DynApp},
        wire::Payload,
    };

    use super::*;

    const APP: AppAddress = AppAddress::new(0x1000);

    #[derive(Serialize, Deserialize)]
    struct Angle {
        degrees: f32,
    }

    impl Payload for Angle {
        const NAME: &'static str = "test.declared.angle";
    }

    #[derive(Serialize, Deserialize)]
    struct Speed {
        value: f32,
    }

    impl Payload for Speed {
        const NAME: &'static str = "test.declared.speed";
    }

    #[derive(Serialize, Deserialize)]
    struct Own {}

    impl Payload for Own {
        const NAME: &'static str = "sinew.test.declared";
    }

    struct Gait;

    impl actix::Actor for Gait {
        type Context = AppContext<Self>;
    }

    fn gait() -> DynApp {
        AppSpec::new("gait", || Gait).sends::<Angle>().sends::<Own>().sends::<Speed>().into()
    }

    #[test]
    fn sent_types_are_published_once_without_those_of_sinew() {
        let (declared, gait) = (Declared::default(), gait());
        let [angle, _, speed] = gait.sends() else { panic!("it sends three") };
        assert!(!declared.sends(APP, *angle), "nothing has this address");
        declared.register(APP, &[], &[*angle]);
        assert!(!declared.sends(APP, *angle) && declared.sends(APP, *speed));
        let changed = declared.take_changed();
        let [(app, types)] = &changed[..] else { panic!("one has changed") };
        let sends = types.hashes().sends;
        assert_eq!((*app, sends.len()), (APP, 2));
        assert_eq!(sends[0], (Angle::KIND, angle.schema().unwrap().hash()));
        assert!(declared.take_changed().is_empty());
        assert_eq!(declared.sent(APP, Speed::KIND), Some(*speed));
        declared.register(APP, &[*angle], gait.sends());
        assert_eq!(declared.sent(APP, Own::KIND), None);
        assert_eq!(declared.handled(APP, Angle::KIND), Some(*angle));
        declared.forget(APP);
        assert_eq!((declared.sent(APP, Speed::KIND), declared.take_changed().len()), (None, 0));
    }
}

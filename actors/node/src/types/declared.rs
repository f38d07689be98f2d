//! The payload types of the applications of this node.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
};

use sinew_model::facts::DeclaredTypes;
use sinew_runtime::{
    lock,
    tid::AppAddress,
    wire::{Kind, PayloadType, SchemaHash},
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

    /// Removes one application from those with changes, and returns it.
    pub(super) fn pop_changed(&self) -> Option<(AppAddress, AppTypes)> {
        let mut table = lock(&self.0);
        while let Some(app) = table.changed.pop_first() {
            if let Some(types) = table.apps.get(&app) {
                return Some((app, types.clone()));
            }
        }
        None
    }

    /// Removes an application that is not registered.
    pub(super) fn forget(&self, app: AppAddress) {
        let mut table = lock(&self.0);
        table.apps.remove(&app);
        table.changed.remove(&app);
    }

    /// Returns the type of this kind that the application handles. `None`: none, or several with different structures.
    pub(super) fn handled(&self, app: AppAddress, kind: Kind) -> Option<PayloadType> {
        let of = of_kind(&lock(&self.0).apps.get(&app)?.handles, kind);
        // Without the lock: each type may be traced.
        is_one(&of).then(|| of.first().copied())?
    }

    /// Returns the type of this kind that the application sends. `None`: none, or several with different structures.
    pub(super) fn sent(&self, app: AppAddress, kind: Kind) -> Option<PayloadType> {
        let of = of_kind(&lock(&self.0).apps.get(&app)?.sends, kind);
        is_one(&of).then(|| of.first().copied())?
    }
}

impl AppTypes {
    /// Traces the types. It may take milliseconds for each, at the first time. Two Rust types of one name and different
    /// structures are left out: nobody knows which of them a message is of.
    pub(super) fn hashes(&self) -> DeclaredTypes {
        let known = |types: &[PayloadType]| {
            let firsts =
                types.iter().enumerate().filter(|(at, one)| of_kind(&types[..*at], one.kind()).is_empty());
            let alone = firsts.filter(|(_, one)| is_one(&of_kind(types, one.kind())));
            alone.filter_map(|(_, one)| Some((one.kind(), hash(*one)?))).collect()
        };
        DeclaredTypes { handles: known(&self.handles), sends: known(&self.sends) }
    }

    /// Returns whether the application has two types of one name. Its published types may become fewer by that.
    pub(super) fn has_two_of_a_kind(&self) -> bool {
        let has_two = |types: &[PayloadType]| types.iter().any(|one| of_kind(types, one.kind()).len() > 1);
        has_two(&self.handles) || has_two(&self.sends)
    }
}

/// Adds a type unless it is there. Returns whether it was added.
fn add(types: &mut Vec<PayloadType>, one: PayloadType) -> bool {
    let is_compared = !one.name().starts_with(OWN_PREFIX);
    let is_new = is_compared && types.len() < TYPES_MAX && !types.contains(&one);
    if is_new {
        types.push(one);
    }
    is_new
}

fn of_kind(types: &[PayloadType], kind: Kind) -> Vec<PayloadType> {
    types.iter().copied().filter(|one| one.kind() == kind).collect()
}

/// Returns whether all these types have one structure.
fn is_one(types: &[PayloadType]) -> bool {
    match types {
        [] | [_] => true,
        [first, others @ ..] => others.iter().all(|other| hash(*other) == hash(*first)),
    }
}

fn hash(one: PayloadType) -> Option<SchemaHash> {
    Some(one.schema().ok()?.hash())
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

    /// Another Rust type with the name of the first.
    #[derive(Serialize, Deserialize)]
    struct OtherAngle {
        radians: f32,
    }

    impl Payload for OtherAngle {
        const NAME: &'static str = Angle::NAME;
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
        let (app, types) = declared.pop_changed().expect("one has changed");
        let sends = types.hashes().sends;
        assert_eq!((app, sends.len()), (APP, 2));
        assert_eq!(sends[0], (Angle::KIND, angle.schema().unwrap().hash()));
        assert!(declared.pop_changed().is_none());
        assert_eq!(declared.sent(APP, Speed::KIND), Some(*speed));
        declared.register(APP, &[*angle], gait.sends());
        assert_eq!(declared.sent(APP, Own::KIND), None);
        assert_eq!(declared.handled(APP, Angle::KIND), Some(*angle));
        declared.forget(APP);
        assert!(declared.sent(APP, Speed::KIND).is_none() && declared.pop_changed().is_none());
    }

    #[test]
    fn two_structures_of_one_name_are_not_published() {
        let declared = Declared::default();
        let app: DynApp =
            AppSpec::new("gait", || Gait).sends::<Angle>().sends::<Speed>().sends::<OtherAngle>().into();
        let [angle, speed, other] = app.sends() else { panic!("it sends three") };
        declared.register(APP, &[], &[*angle, *speed]);
        assert_eq!(declared.pop_changed().map(|(_, types)| types.hashes().sends.len()), Some(2));
        assert!(declared.sends(APP, *other), "it is another type");
        let (_, types) = declared.pop_changed().expect("it has changed");
        assert!(types.has_two_of_a_kind());
        let kinds: Vec<_> = types.hashes().sends.into_iter().map(|(kind, _)| kind).collect();
        assert_eq!(kinds, [Speed::KIND]);
        assert_eq!((declared.sent(APP, Angle::KIND), declared.sent(APP, Speed::KIND)), (None, Some(*speed)));
    }
}

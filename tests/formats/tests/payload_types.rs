//! Every payload type of this tree has a structure that is traced, or is named here with the reason why not.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use exoskeleton::robot::edges::{Arm, BarrierStatus, EmergencyStop, GaitStatus, Release, Reset, Shut};
use exoskeleton_model::message::{DriveStatus, DriveTick, FootLoad, GaitState, JointSample, TorqueSet};
use sinew::{
    Payload,
    contracts::{AskContracts, ContractsReport},
    events::{DirectoryEvent, Down, NodeEvent, RequirementEvent, Undelivered},
    inspect::{
        AccessReport, AppsReport, AskAccess, AskApps, AskAudit, AskFreeze, AskFrozen, AskGroups, AskLogs,
        AskMismatches, AskNode, AskReach, AskRecord, AskReload, AskSchemas, AskTree, AskWatch, AuditReport,
        FreezeReport, FrozenReport, LogsReport, MismatchesReport, NodeReport, Ping, ReachReport,
        RecordReport, ReloadReport, SchemasReport, TreeReport, WatchReport,
    },
    parameters::{AskParameters, ParameterList, ParameterOutcome, ParameterVote, SetParameters},
    schema::{Schema, schema_of},
    stop::{AcknowledgeStop, AskStop, PressStop, ReleaseStop, StopReport},
};
use sinew_model::barrier::{ArriveAtBarrier, BarrierAnswer, LeaveBarrier};

/// Payload types that no other package can name: they are declared in programs, and traced where these run.
const IN_PROGRAMS: [&str; 19] = [
    "ask.angle",
    "ask.get_angle",
    "ask.move",
    "client_task.torque",
    "client_thread.angle",
    "client_thread.get_angle",
    "client_thread.move",
    "demo.calibrate",
    "demo.joint_angle",
    "fuzz.torque",
    "group.stop",
    "guarded_motor.torque",
    "hello.bend",
    "own_process.hello",
    "sinew.echo", // A test of sinew-runtime traces it.
    "stream.command",
    "stream.position",
    "supervisor.move",
    "two_nodes.angle",
];

/// Types without a fixed structure, and the reason.
const UNTRACED: [(&str, &str); 0] = [];

fn traced<P: Payload>(names: &mut BTreeSet<&'static str>) {
    let schema = schema_of::<P>().expect("the table has room");
    let reason = UNTRACED.iter().find(|(name, _)| *name == P::NAME);
    match (schema, reason) {
        (Ok(schema), None) => {
            let read = Schema::parse(&schema.schema().encode());
            assert_eq!(read.as_ref(), Ok(schema.schema()), "{}", P::NAME);
        }
        (Err(error), None) => panic!("{}: {error}", P::NAME),
        (Ok(_), Some(_)) => panic!("{} is traced, and needs no exception", P::NAME),
        (Err(_), Some(_)) => {}
    }
    assert!(names.insert(P::NAME), "{} is listed twice", P::NAME);
}

macro_rules! traced {
    ($($payload:ty)*) => {{
        let mut names = BTreeSet::new();
        $(traced::<$payload>(&mut names);)*
        names
    }};
}

/// Returns the names of payload types in the files below `folder`, without those of tests and of comments.
fn declared(folder: &Path, names: &mut BTreeSet<String>) {
    let entries = fs::read_dir(folder).expect("the source tree can be read");
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.expect("it can be read").path()).collect();
    paths.sort();
    for path in paths {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
        if path.is_dir() && !["tests", "benches", "target"].contains(&&*name) {
            declared(&path, names);
        } else if name.ends_with(".rs") && !name.contains("tests") {
            let text = fs::read_to_string(&path).expect("it is a text");
            let is_code = |line: &&str| !line.trim_start().starts_with("//");
            let code: Vec<_> = text.lines().filter(is_code).collect();
            let code = code.join("\n");
            let code = code.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
            for opening in ["payload!(\"", "const NAME: &'static str = \""] {
                let found = code.split(opening).skip(1).filter_map(|rest| rest.split('"').next());
                names.extend(found.map(str::to_owned));
            }
        }
    }
}

#[test]
fn every_payload_type_of_this_tree_is_traced() {
    let traced = traced! {
        Arm BarrierStatus EmergencyStop GaitStatus Release Reset Shut
        DriveStatus DriveTick FootLoad GaitState JointSample TorqueSet
        DirectoryEvent Down NodeEvent RequirementEvent Undelivered
        AccessReport AppsReport AskAccess AskApps AskAudit AskFreeze AskFrozen AskGroups AskLogs AskMismatches AskNode
        AskReach AskRecord AskReload AskSchemas AskTree AskWatch AuditReport FreezeReport FrozenReport LogsReport
        MismatchesReport NodeReport Ping ReachReport RecordReport ReloadReport SchemasReport TreeReport WatchReport
        ArriveAtBarrier BarrierAnswer LeaveBarrier
        AskContracts ContractsReport
        AskParameters ParameterList ParameterOutcome ParameterVote SetParameters
        AcknowledgeStop AskStop PressStop ReleaseStop StopReport
    };
    let mut names = BTreeSet::new();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    for folder in ["runtime/src", "actors", "cli/src", "examples"] {
        declared(&root.join(folder), &mut names);
    }
    assert!(names.len() > 50, "only {} payload types were found", names.len());
    let is_known = |name: &&String| traced.contains(&***name) || IN_PROGRAMS.contains(&&***name);
    let unknown: Vec<_> = names.iter().filter(|name| !is_known(name)).collect();
    assert!(unknown.is_empty(), "list these types here, so that they are traced: {unknown:?}");
    let gone: Vec<_> = IN_PROGRAMS.iter().filter(|name| !names.contains(**name)).collect();
    assert!(gone.is_empty(), "no type has these names any more: {gone:?}");
}

//! Sessions in memory. The start of a process needs the program itself, and is tested with the commands.

use std::io::Cursor;

use sinew_testkit::TestDirectory;

use super::*;
use crate::up::{
    order::{Hash, PlacedFile, ProgramOrder, tests::order},
    protocol::CONTENT_BYTES_MAX,
};

fn asks_nothing(_: &Path) -> Result<Vec<AppSeen>, String> {
    Err("nothing is asked here".to_owned())
}

/// Serves requests, each with the content behind it, and returns the answers.
fn served(requests: &[(Request, &[u8])]) -> Vec<Answer> {
    let mut input = Vec::new();
    for (request, content) in requests {
        input.extend(serde_json::to_vec(request).expect("a request is JSON"));
        input.push(b'\n');
        input.extend_from_slice(content);
    }
    let mut output = Vec::new();
    serve(&mut Cursor::new(input), &mut output, asks_nothing).expect("memory is readable");
    let lines = output.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    lines.map(|line| serde_json::from_slice(line).expect("an answer is JSON")).collect()
}

fn enter(directory: &TestDirectory, changes: bool) -> (Request, &'static [u8]) {
    let folder = Some(directory.join("state").display().to_string());
    (Request::Enter { robot: "leg".to_owned(), folder, changes }, b"")
}

fn put(content: &'static [u8]) -> (Hash, (Request, &'static [u8])) {
    let (hash, bytes) = Hash::of(content).expect("memory is readable");
    (hash.clone(), (Request::Put { hash, bytes }, content))
}

#[test]
fn placed_files_go_again_and_leave_nothing() {
    let directory = TestDirectory::new();
    let ((program, put_program), (key, put_key)) = (put(b"a program"), put(b"a key"));
    let files = vec![PlacedFile { path: "keys/node.key".to_owned(), hash: key.clone() }];
    let copied = ProgramOrder::Copied { name: "knee".to_owned(), hash: program.clone() };
    let order = NodeOrder { program: copied, files, ..order("knee", 1) };
    let unit = (Request::WriteUnit { order: order.clone(), unit: "[Unit]\n".to_owned() }, &b""[..]);
    let missing = || (Request::Missing(vec![program.clone(), key.clone()]), &b""[..]);
    let answers = served(&[enter(&directory, true), missing(), put_program, put_key, missing(), unit]);
    let Answer::Missing(before) = &answers[1] else { panic!("{answers:?}") };
    let Answer::Missing(after) = &answers[4] else { panic!("{answers:?}") };
    assert_eq!((before.len(), after.len()), (2, 0), "{answers:?}");
    let node = directory.join("state/robots/leg/nodes/knee");
    assert_eq!(std::fs::read(node.join("bin/knee")).expect("it was placed"), b"a program");
    assert_eq!(std::fs::read(node.join("keys/node.key")).expect("it was placed"), b"a key");
    std::fs::write(node.join("walk.mcap"), "of the node").expect("the test's own directory");
    // A file of the node stays, and is named.
    let remove = || (Request::Remove { node: "knee".to_owned() }, &b""[..]);
    let answers = served(&[enter(&directory, true), remove(), (Request::Sweep, b"")]);
    let Answer::Done(note) = &answers[1] else { panic!("{answers:?}") };
    assert!(note.starts_with("not made by `sinew up`: ") && note.ends_with("knee/walk.mcap"), "{note}");
    assert!(!node.join("keys").exists() && !node.join("bin").exists());
    std::fs::remove_file(node.join("walk.mcap")).expect("it stayed");
    served(&[enter(&directory, true), remove(), (Request::Sweep, b"")]);
    assert!(!directory.join("state").exists(), "the folder of all robots is left");
}

#[test]
fn content_that_differs_from_its_hash_is_refused() {
    let directory = TestDirectory::new();
    let (hash, _) = put(b"a program");
    let cut = (Request::Put { hash: hash.clone(), bytes: 9 }, &b"a problem"[..]);
    let long = (Request::Put { hash: hash.clone(), bytes: CONTENT_BYTES_MAX + 1 }, &b""[..]);
    let missing = (Request::Missing(vec![hash]), &b""[..]);
    let answers = served(&[enter(&directory, true), cut, long, missing]);
    for refused in &answers[1..3] {
        assert!(matches!(refused, Answer::Refused(_)), "{answers:?}");
    }
    assert!(matches!(&answers[3], Answer::Missing(missing) if missing.len() == 1), "{answers:?}");
}

#[test]
fn second_caller_that_changes_is_refused() {
    let directory = TestDirectory::new();
    let folder = directory.join("state").display().to_string();
    let first = Store::open("leg", Some(&folder), true).expect("the test's own directory");
    let answers = served(&[enter(&directory, true), enter(&directory, false)]);
    assert!(matches!(&answers[0], Answer::Refused(why) if why.contains("another `sinew up`")), "{answers:?}");
    assert!(matches!(answers[1], Answer::Entered { .. }), "a look needs no lock: {answers:?}");
    drop(first);
    assert!(matches!(served(&[enter(&directory, true)])[0], Answer::Entered { .. }));
}

#[test]
fn names_never_lead_out_of_the_folder() {
    let directory = TestDirectory::new();
    for name in ["../leg", "..", "a/b", ""] {
        let stop = (Request::Stop { node: name.to_owned(), within_ms: 1 }, &b""[..]);
        let start = (Request::Start(order(name, 1)), &b""[..]);
        let answers = served(&[enter(&directory, true), stop, start]);
        for refused in &answers[1..] {
            assert!(matches!(refused, Answer::Refused(why) if why.contains("can be called")), "{answers:?}");
        }
    }
    let outside = PlacedFile { path: "../../x".to_owned(), hash: put(b"x").0 };
    let order = NodeOrder { files: vec![outside], ..order("knee", 1) };
    let answers = served(&[enter(&directory, true), put(b"x").1, (Request::Start(order), b"")]);
    assert!(matches!(&answers[2], Answer::Refused(why) if why.contains("../../x")), "{answers:?}");
}

#[test]
fn unreadable_requests_are_refused_one_by_one() {
    let mut output = Vec::new();
    serve(&mut Cursor::new(b"nonsense\n{}\n"), &mut output, asks_nothing).expect("memory is readable");
    assert_eq!(output.iter().filter(|byte| **byte == b'\n').count(), 2);
    let answers = served(&[(Request::Sweep, b"")]);
    assert!(matches!(&answers[0], Answer::Refused(why) if why.contains("enter a robot")), "{answers:?}");
}

#[test]
fn log_is_shown_from_the_begin_of_a_line() {
    let directory = TestDirectory::new();
    let path = directory.write("log", "first\nsecond\nthird\n");
    assert_eq!(log(&path, 100), Ok("first\nsecond\nthird\n".to_owned()));
    assert_eq!(log(&path, 10), Ok("third\n".to_owned()));
    assert_eq!(log(&directory.join("none"), 10), Ok(String::new()));
    let path = directory.write("log", "1\n2\n3\n4\n5\n6\n");
    assert_eq!(last_lines(&path), "3\n4\n5\n6");
}

//! Selection of the sockets to ask among those found.

use std::os::unix::{
    fs::{chown, lchown, symlink},
    net::UnixListener,
};

use sinew_testkit::TestDirectory;

use super::*;

/// A user that is neither root nor this one. No account needs to exist for it.
const STRANGER: u32 = 54_321;

/// Returns whether this process may change the owner of files.
fn can_give_away() -> bool {
    let can = rustix::process::geteuid().is_root();
    if !can {
        println!("skipped: only root can give a file to another user");
    }
    can
}

fn place(directory: &TestDirectory) -> SocketFolder {
    SocketFolder { directory: directory.join(""), prefix: "sinew-" }
}

/// A listener at this path that sends nothing.
fn listens(path: &Path) -> UnixListener {
    let listener = UnixListener::bind(path).expect("the test's own directory");
    listener.set_nonblocking(true).expect("it is a socket");
    listener
}

fn was_asked(listener: &UnixListener) -> bool {
    listener.accept().is_ok()
}

#[test]
fn first_accepting_own_socket_is_used_and_failures_listed() {
    let directory = TestDirectory::new();
    fs::write(directory.join("sinew-a\u{1b}[2J.sock"), "").expect("the test's own directory");
    let find = || find_at(vec![place(&directory)], own_uid());
    let seen = find().expect_err("nothing listens");
    assert!(seen.contains("sinew-a\\u{1b}[2J.sock: "), "{seen}");
    assert!(!seen.contains('\u{1b}'), "what terminals obey is not shown");
    let listener = listens(&directory.join("sinew-b.sock"));
    let (path, _) = find().expect("it is ours");
    assert!(path.ends_with("sinew-b.sock") && was_asked(&listener));
}

#[test]
fn empty_place_is_listed() {
    let directory = TestDirectory::new();
    let seen = find_at(vec![place(&directory)], own_uid()).expect_err("nothing is there");
    assert!(seen.contains("sinew-*.sock: nothing there"), "{seen}");
}

#[test]
fn socket_of_another_user_is_listed_but_not_asked() {
    if !can_give_away() {
        return;
    }
    let directory = TestDirectory::new();
    let path = directory.join("sinew-0.sock");
    let theirs = listens(&path);
    chown(&path, Some(STRANGER), None).expect("root may");
    let find = || find_at(vec![place(&directory)], own_uid());
    // When: there is no other socket. Then:
    let seen = find().expect_err("it is not ours");
    let words = "sinew-0.sock belongs to uid 54321: not asked; name it with --socket to ask it nevertheless";
    assert!(seen.contains(words), "{seen}");
    // When: an own socket follows it. Then:
    let ours = listens(&directory.join("sinew-1.sock"));
    let (found, _) = find().expect("it is ours");
    assert!(found.ends_with("sinew-1.sock") && was_asked(&ours));
    // When: further sockets are searched for. Then:
    let others = |named: &[PathBuf]| {
        others_at(&found, named, std::iter::once(place(&directory)), (own_uid(), FOUND_WITHIN))
    };
    let found_alone = others(&[]);
    assert!(found_alone.nodes.is_empty() && !was_asked(&theirs), "it was asked nothing in all this");
    assert!(
        matches!(&found_alone.left_out[..], [words] if words.contains("54321") && words.contains("--other-socket")),
        "{:?}",
        found_alone.left_out
    );
    // When: the socket is named explicitly. Then:
    let named = others(std::slice::from_ref(&path));
    assert!(named.nodes.len() == 1 && named.left_out.is_empty() && was_asked(&theirs));
}

#[test]
fn link_is_asked_if_link_and_target_are_own() {
    if !can_give_away() {
        return;
    }
    let (directory, elsewhere) = (TestDirectory::new(), TestDirectory::new());
    let [ours, theirs] = ["ours.sock", "theirs.sock"].map(|name| elsewhere.join(name));
    let (_ours, _theirs) = (listens(&ours), listens(&theirs));
    chown(&theirs, Some(STRANGER), None).expect("root may");
    for (name, target, is_ours) in
        [("sinew-0.sock", &ours, false), ("sinew-1.sock", &theirs, true), ("sinew-2.sock", &ours, true)]
    {
        let link = directory.join(name);
        symlink(target, &link).expect("the test's own directory");
        if !is_ours {
            lchown(&link, Some(STRANGER), None).expect("root may");
        }
    }
    let found = Found::at(&place(&directory), own_uid());
    let names = |paths: &[PathBuf]| paths.iter().map(|path| shown(path)).collect::<String>();
    assert!(found.own.len() == 1 && names(&found.own).ends_with("sinew-2.sock"), "{found:?}");
    assert_eq!(found.left_out.iter().map(|one| one.uid).collect::<Vec<_>>(), [STRANGER; 2]);
}

#[test]
fn many_sockets_of_another_user_hide_no_own_one() {
    if !can_give_away() {
        return;
    }
    let directory = TestDirectory::new();
    for number in 0..SOCKETS_MAX + LEFT_OUT_MAX {
        let path = directory.join(&format!("sinew-{number}.sock"));
        fs::write(&path, "").expect("the test's own directory");
        chown(&path, Some(STRANGER), None).expect("root may");
    }
    let error = find_at(vec![place(&directory)], own_uid()).expect_err("all are theirs");
    assert!(error.contains("64 more there belong to other users: not asked"), "{error}");
    assert_eq!(error.matches("belongs to uid 54321").count(), LEFT_OUT_MAX);
    let _ours = listens(&directory.join("sinew-ours.sock"));
    let (path, _) = find_at(vec![place(&directory)], own_uid()).expect("it is ours");
    assert!(path.ends_with("sinew-ours.sock"));
}

#[test]
fn sockets_are_not_asked_after_the_time_limit() {
    let directory = TestDirectory::new();
    let path = directory.join("sinew-0.sock");
    let listener = listens(&path);
    let why = ask(&path, Time::ZERO).expect_err("no time is left");
    assert!(why.contains("not asked") && !was_asked(&listener), "{why}");
}

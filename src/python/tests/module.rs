//! The tests of the Python package, with the module as it is built for the tests of the workspace.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs the tests in Python, and the code of a notebook. `.ci/python` has the tests that take longest, and the
/// other notebook.
///
/// The module must be built: `cargo test -p regrind-python --features extension-module -- --ignored`. The variable
/// `REGRIND_NUMPY_PYTHON` names a Python that has numpy, matplotlib and pytest.
#[test]
#[ignore = "needs a Python with numpy, matplotlib and pytest: REGRIND_NUMPY_PYTHON"]
fn python_package_passes_its_tests() {
    let python = std::env::var_os("REGRIND_NUMPY_PYTHON").expect("REGRIND_NUMPY_PYTHON names a Python with numpy");
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scratch = tempfile::tempdir().unwrap();
    // The folders lie beside each other as in the sources, because a test reads the files of another crate's tests.
    let folder = &scratch.path().join("python");
    let of_formats = "formats/tests/fixtures/cad";
    copy(&package.join("..").join(of_formats), &scratch.path().join(of_formats));
    copy(&package.join("python/regrind"), &folder.join("regrind"));
    copy(&package.join("tests"), &folder.join("tests"));
    copy(&package.join("notebooks"), &folder.join("notebooks"));
    std::fs::copy(package.join("README.md"), folder.join("README.md")).unwrap();
    std::fs::copy(module(), folder.join("regrind/_regrind.abi3.so")).unwrap();
    // The program is beside the folder of the tests.
    let beside = std::env::current_exe().unwrap().parent().and_then(Path::parent).unwrap().to_owned();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([beside].into_iter().chain(std::env::split_paths(&path))).unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Command::new(&python);
        command.args(arguments).current_dir(folder).env("PYTHONPATH", folder).env("PATH", &path);
        let done = command.env("MPLBACKEND", "agg").env("PYTHONDONTWRITEBYTECODE", "1").output().unwrap();
        let [said, errors] = [&done.stdout, &done.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned());
        assert!(done.status.success(), "{arguments:?}: {said}{errors}");
        said
    };
    const LONG: &str = "ten_thousand contenders wheel_is_one_radius changes_meanwhile spread_as cases_are_the_same";
    let others = LONG.split(' ').map(|name| format!("not {name}")).collect::<Vec<_>>().join(" and ");
    run(&["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", &others, "tests"]);
    let code = run(&["tests/code_of.py", "notebooks/cmm_to_verdict.ipynb"]);
    std::fs::write(folder.join("notebook.py"), code).unwrap();
    run(&["notebook.py"]);
}

/// Returns the path of the module that Cargo built last.
fn module() -> PathBuf {
    let folder = std::env::current_exe().unwrap().parent().unwrap().to_owned();
    let of_module = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.starts_with("lib_regrind") && name.ends_with(".so")
    };
    let modules = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).filter(of_module);
    let newest = modules.max_by_key(|path| path.metadata().and_then(|found| found.modified()).unwrap());
    newest.expect("the feature extension-module builds the module")
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else if path.extension().is_none_or(|extension| extension != "so" && extension != "pyc") {
            std::fs::copy(&path, &target).unwrap();
        }
    }
}

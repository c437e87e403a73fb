//! Finds MuJoCo 2.2, generates bindings from its headers, compiles the error shim, and lists MuJoCo's array fields.
//!
//! Metadata for dependants (`links = "mujoco"`): `DEP_MUJOCO_FIELDS` is a file with one line
//! `struct|type|name|rows|columns` per array of mjModel and mjData, `DEP_MUJOCO_INCLUDE` is the directory of the
//! headers, and `DEP_MUJOCO_RPATH` is the directory of the library if it is outside the loader's search path.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::exit;
use std::{env, fs};

const FIX: &str = "run `./setup`, or `apt-get install libmujoco-dev libclang-dev` on Debian 12, \
                   or set MUJOCO_DIR to an unpacked MuJoCo 2.2 release";

/// Ends the build with a one-line error. `cargo::error` fails the build; a non-zero exit status would make Cargo
/// print the whole output of this script as well.
fn fail(message: &str) -> ! {
    println!("cargo::error={message}");
    exit(0);
}

struct Mujoco {
    include: PathBuf,
    library: PathBuf,
    on_system_path: bool,
}

fn find() -> Mujoco {
    println!("cargo::rerun-if-env-changed=MUJOCO_DIR");
    let triple = format!("{}-linux-gnu", env::var("CARGO_CFG_TARGET_ARCH").unwrap_or_default());
    let (includes, libraries, on_system_path) = match env::var_os("MUJOCO_DIR") {
        Some(dir) if !dir.is_empty() => {
            // MUJOCO_DIR is relative to the workspace root, one level above the directory of this script
            let dir = Path::new("..").join(dir);
            let dir = dir.canonicalize().unwrap_or_else(|error| {
                fail(&format!("MUJOCO_DIR is {} which cannot be read ({error}): unset it, or {FIX}", dir.display()))
            });
            let libraries = vec![dir.join("lib"), dir.join("lib").join(&triple), dir.join("lib64")];
            (vec![dir.join("include")], libraries, false)
        }
        _ => (
            vec!["/usr/include".into(), "/usr/local/include".into()],
            vec![Path::new("/usr/lib").join(&triple), "/usr/lib64".into(), "/usr/lib".into(), "/usr/local/lib".into()],
            true,
        ),
    };
    let Some(include) = includes.iter().find(|dir| dir.join("mujoco/mujoco.h").is_file()) else {
        fail(&format!("no mujoco/mujoco.h in {}: {FIX}", list(&includes)));
    };
    let Some(library) = libraries.iter().find(|dir| dir.join("libmujoco.so").is_file()) else {
        fail(&format!("no libmujoco.so in {}: {FIX}", list(&libraries)));
    };
    Mujoco { include: include.clone(), library: library.clone(), on_system_path }
}

fn list(dirs: &[PathBuf]) -> String {
    dirs.iter().map(|dir| dir.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Fails unless the headers and the library are MuJoCo 2.2: the layout of structures differs in every other minor
/// version.
fn check_version(mujoco: &Mujoco) {
    let header = mujoco.include.join("mujoco/mujoco.h");
    let text = fs::read_to_string(&header)
        .unwrap_or_else(|error| fail(&format!("{} cannot be read ({error}): {FIX}", header.display())));
    let version = text
        .lines()
        .find_map(|line| line.trim().strip_prefix("#define mjVERSION_HEADER"))
        .and_then(|rest| rest.trim().parse::<u32>().ok());
    match version {
        Some(220..=229) => {}
        Some(other) => {
            let (major, minor) =
                if other < 1000 { (other / 100, other / 10 % 10) } else { (other / 1_000_000, other / 1000 % 1000) };
            fail(&format!("{} belongs to MuJoCo {major}.{minor}, expected 2.2: {FIX}", header.display()))
        }
        None => fail(&format!("{} does not define mjVERSION_HEADER: {FIX}", header.display())),
    }

    // the soname is part of the dynamic string table, so that a search of the bytes needs no external tool
    let library = mujoco.library.join("libmujoco.so");
    let bytes = fs::read(&library)
        .unwrap_or_else(|error| fail(&format!("{} cannot be read ({error}): {FIX}", library.display())));
    let soname = b"libmujoco.so.2.2.";
    if !bytes.windows(soname.len()).any(|window| window == soname) {
        fail(&format!("{} is not a MuJoCo 2.2 library: {FIX}", library.display()));
    }
    println!("cargo::rerun-if-changed={}", header.display());
    println!("cargo::rerun-if-changed={}", library.display());
}

fn bind(mujoco: &Mujoco, out: &Path) {
    let include = format!("-I{}", mujoco.include.display());
    let build = || {
        bindgen::Builder::default()
            .header("shim/shim.h")
            .clang_arg(&include)
            .allowlist_item("mj.*|MJ.*|_mj.*")
            .default_enum_style(bindgen::EnumVariation::ModuleConsts)
            .derive_default(false)
            .layout_tests(true)
            .generate_comments(false)
            .generate()
    };
    // bindgen's loader panics if libclang is missing; the message below replaces the panic's
    std::panic::set_hook(Box::new(|_| {}));
    let result = std::panic::catch_unwind(build);
    let _ = std::panic::take_hook();
    let bindings = match result {
        Ok(Ok(bindings)) => bindings,
        Ok(Err(error)) => {
            let error = error.to_string().replace('\n', "; ");
            fail(&format!("bindgen could not read MuJoCo's headers in {} ({error}): {FIX}", mujoco.include.display()))
        }
        Err(_) => fail(&format!("libclang, which reads MuJoCo's headers, was not found: {FIX}")),
    };
    let path = out.join("bindings.rs");
    bindings.write_to_file(&path).unwrap_or_else(|error| fail(&format!("{}: {error}", path.display())));
}

struct Field {
    owner: String,
    kind: String,
    name: String,
    rows: String,
    columns: String,
}

/// Returns MuJoCo's array fields, read from MuJoCo's X macros (`mjxmacro.h`).
fn fields(mujoco: &Mujoco) -> Vec<Field> {
    let expanded = cc::Build::new()
        .file("shim/fields.c")
        .flag("-P") // no line markers between the records
        .include(&mujoco.include)
        .try_expand()
        .unwrap_or_else(|error| {
            fail(&format!("no C compiler for MuJoCo's headers ({error}): run `./setup`, or `apt-get install g++`"))
        });
    let expanded = String::from_utf8_lossy(&expanded);
    let fields: Vec<Field> = expanded
        .split("@@")
        .filter_map(|record| {
            let parts: Vec<_> = record.split('|').map(|part| part.trim().replace(' ', "")).collect();
            let [owner, kind, name, rows, columns] = <[String; 5]>::try_from(parts).ok()?;
            Some(Field { owner, kind, name, rows, columns })
        })
        .collect();
    if fields.len() < 300 {
        fail(&format!("mjxmacro.h in {} lists only {} fields: {FIX}", mujoco.include.display(), fields.len()));
    }
    fields
}

/// Structures whose fields this workspace reads and writes.
const STRUCTURES: [&str; 19] = [
    "mjModel",
    "mjData",
    "mjOption",
    "mjVisual",
    "mjStatistic",
    "mjContact",
    "mjVFS",
    "mjvScene",
    "mjvOption",
    "mjvCamera",
    "mjvGeom",
    "mjvLight",
    "mjvGLCamera",
    "mjvPerturb",
    "mjrContext",
    "mjrRect",
    "mjWarningStat",
    "mjTimerStat",
    "mjSolverStat",
];

/// Returns the fields of a structure in the generated bindings; fields of nested anonymous structures as
/// `outer.inner`.
fn members(bindings: &str, structure: &str) -> Vec<String> {
    let opening = format!("pub struct {structure} {{");
    let Some(body) = bindings.split_once(&opening).and_then(|(_, rest)| rest.split_once("\n}")) else {
        fail(&format!("{structure} is not in the bindings to MuJoCo's headers: {FIX}"));
    };
    let mut found = Vec::new();
    for line in body.0.lines() {
        let Some((name, kind)) = line.trim().strip_prefix("pub ").and_then(|field| field.split_once(": ")) else {
            continue;
        };
        let kind = kind.trim_end_matches(',');
        if kind.contains("__bindgen_ty_") && !kind.contains(' ') {
            found.extend(members(bindings, kind).into_iter().map(|inner| format!("{name}.{inner}")));
        } else {
            found.push(name.to_string());
        }
    }
    found
}

/// Writes the layout table twice, for the C compiler and for Rust; a test compares them entry by entry.
fn layout(out: &Path) {
    let path = out.join("bindings.rs");
    let bindings = fs::read_to_string(&path).unwrap_or_else(|error| fail(&format!("{}: {error}", path.display())));
    let mut c = String::new();
    let mut rust = String::from("const RUST_LAYOUT: &[(&str, usize)] = &[\n");
    for structure in STRUCTURES {
        let _ = writeln!(c, "sizeof({structure}),");
        let _ = writeln!(rust, "(\"sizeof {structure}\", std::mem::size_of::<super::{structure}>()),");
        for field in members(&bindings, &format!("{structure}_")) {
            // bindgen renames fields whose names are Rust keywords
            let c_field = if field == "type_" { "type" } else { &field };
            let _ = writeln!(c, "__builtin_offsetof({structure}, {c_field}),");
            let _ = writeln!(rust, "(\"{structure}.{field}\", std::mem::offset_of!(super::{structure}, {field})),");
        }
    }
    rust.push_str("];\n");
    write(&out.join("layout.inc"), &c);
    write(&out.join("layout.rs"), &rust);
}

fn write(path: &Path, text: &str) {
    fs::write(path, text).unwrap_or_else(|error| fail(&format!("{}: {error}", path.display())));
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=shim");
    let mujoco = find();
    check_version(&mujoco);
    let out = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_else(|| fail("OUT_DIR is not set")));

    let fields = fields(&mujoco);
    let listing: String =
        fields.iter().map(|f| format!("{}|{}|{}|{}|{}\n", f.owner, f.kind, f.name, f.rows, f.columns)).collect();
    write(&out.join("fields.txt"), &listing);
    println!("cargo::metadata=FIELDS={}", out.join("fields.txt").display());
    println!("cargo::metadata=INCLUDE={}", mujoco.include.display());

    bind(&mujoco, &out);
    layout(&out);
    // the error handler throws through MuJoCo's frames and, in the parser, through the shim's C frames
    let shim = || cc::Build::new().include(&mujoco.include).include(&out).warnings_into_errors(true).to_owned();
    let built = shim()
        .files(["shim/shim.c", "shim/environment.c"])
        .std("c11")
        .flag("-fexceptions")
        .try_compile("mjshim")
        .and_then(|()| shim().cpp(true).std("c++17").file("shim/load.cc").try_compile("mjshim_load"));
    if let Err(error) = built {
        let error = error.to_string();
        let reason = error.lines().next().unwrap_or_default();
        fail(&format!("the C shim did not compile ({reason}): run `./setup`, or `apt-get install g++`"));
    }

    println!("cargo::rustc-link-search=native={}", mujoco.library.display());
    println!("cargo::rustc-link-lib=dylib=mujoco");
    if !mujoco.on_system_path {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{}", mujoco.library.display());
        println!("cargo::metadata=RPATH={}", mujoco.library.display());
    }
}

//! Generates an accessor for every array of mjModel and mjData from MuJoCo's list of fields, so that no array is
//! missing and every length equals MuJoCo's allocation.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::{env, fs};

/// Arrays of mjModel that callers may write freely: MuJoCo's C code only computes with their values. Values of
/// every other array decide which memory is accessed (sizes and orientations of geoms in collision detection,
/// height fields in rays, vertices of meshes), so that its mutable slice is `unsafe`.
const FREE_IN_MODEL: &[&str] = &[
    "qpos0",
    "qpos_spring",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "body_user",
    "jnt_solref",
    "jnt_solimp",
    "jnt_stiffness",
    "jnt_user",
    "dof_solref",
    "dof_solimp",
    "dof_frictionloss",
    "dof_armature",
    "dof_damping",
    "dof_invweight0",
    "dof_M0",
    "geom_solmix",
    "geom_solref",
    "geom_solimp",
    "geom_friction",
    "geom_user",
    "geom_rgba",
    "site_user",
    "site_rgba",
    "cam_user",
    "light_attenuation",
    "light_ambient",
    "light_diffuse",
    "light_specular",
    "mat_emission",
    "mat_specular",
    "mat_shininess",
    "mat_reflectance",
    "mat_rgba",
    "pair_solref",
    "pair_solimp",
    "pair_friction",
    "eq_solref",
    "eq_solimp",
    "tendon_stiffness",
    "tendon_damping",
    "tendon_frictionloss",
    "tendon_user",
    "tendon_rgba",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_ctrlrange",
    "actuator_forcerange",
    "actuator_actrange",
    "actuator_gear",
    "actuator_user",
    "sensor_cutoff",
    "sensor_noise",
    "sensor_user",
    "numeric_data",
    "key_time",
    "key_qpos",
    "key_qvel",
    "key_act",
    "key_mpos",
    "key_mquat",
    "key_ctrl",
];

/// Arrays of mjData that callers may write freely: MuJoCo's inputs, whose range every step and forward pass checks,
/// and the poses of lights, which only rendering reads. MuJoCo computes the others from these, so that their
/// mutable slice is `unsafe`.
const FREE_IN_DATA: &[&str] = &[
    "qpos",
    "qvel",
    "act",
    "qacc_warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "mocap_pos",
    "mocap_quat",
    "userdata",
    "light_xpos",
    "light_xdir",
];

/// Returns the comment behind a field's declaration in MuJoCo's headers, where MuJoCo documents it.
fn comment(headers: &str, name: &str) -> String {
    let declaration = format!("{name};");
    headers
        .lines()
        .find(|line| {
            line.trim_start().split_once('*').is_some_and(|(_, rest)| rest.trim_start().starts_with(&declaration))
        })
        .and_then(|line| line.split_once("//"))
        .map(|(_, text)| {
            let text = text.rsplit_once('(').map_or(text, |(text, _)| text).trim().trim_end_matches([';', ':']);
            let mut escaped = String::with_capacity(text.len());
            for letter in text.chars() {
                if matches!(letter, '[' | ']' | '<' | '>' | '*' | '_' | '`') {
                    escaped.push('\\');
                }
                escaped.push(letter);
            }
            escaped
        })
        .filter(|text| !text.is_empty())
        .unwrap_or_else(|| String::from("see MuJoCo's reference"))
}

/// Translates a size in the macro's terms (`nq`, `mjNREF`, `nmocap*3`, `6`) to a Rust expression of usize.
fn size(expression: &str) -> String {
    expression
        .split('*')
        .map(|factor| {
            if factor.parse::<usize>().is_ok() {
                factor.to_string()
            } else if factor.starts_with("mj") {
                format!("mujoco_sys::{factor} as usize")
            } else {
                format!("model.{factor} as usize")
            }
        })
        .map(|factor| format!("({factor})"))
        .collect::<Vec<_>>()
        .join(" * ")
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=DEP_MUJOCO_RPATH");
    if let Ok(rpath) = env::var("DEP_MUJOCO_RPATH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{rpath}");
        println!("cargo::metadata=RPATH={rpath}");
    }

    let listing = PathBuf::from(env::var_os("DEP_MUJOCO_FIELDS").expect("mujoco-sys names its list of fields"));
    let include = PathBuf::from(env::var_os("DEP_MUJOCO_INCLUDE").expect("mujoco-sys names the header directory"));
    println!("cargo::rerun-if-changed={}", listing.display());
    let listing = fs::read_to_string(listing).expect("the list of fields is readable");
    let header =
        |name: &str| fs::read_to_string(include.join("mujoco").join(name)).expect("MuJoCo's headers are readable");
    let (model_header, data_header) = (header("mjmodel.h"), header("mjdata.h"));

    let (mut model, mut model_mut, mut data, mut sizes) = (String::new(), String::new(), String::new(), String::new());
    for line in listing.lines() {
        let [owner, kind, name, rows, columns] = line.split('|').collect::<Vec<_>>()[..] else {
            panic!("not a field: {line}");
        };
        if owner == "size" {
            let _ = writeln!(
                sizes,
                "    /// `{name}` of mjModel.\n    #[inline]\n    \
                 pub fn {name}(&self) -> usize {{ self.raw().{name} as usize }}"
            );
            continue;
        }
        let element = match kind {
            "mjtNum" => "f64",
            "float" => "f32",
            "int" => "i32",
            "mjtByte" => "u8",
            "char" => "std::ffi::c_char",
            "mjContact" => "mujoco_sys::mjContact",
            other => panic!("element type {other} of {name} is not known"),
        };
        // contacts have a separate accessor that ends at the last contact
        if element.starts_with("mujoco_sys") {
            continue;
        }
        let headers = if owner == "model" { &model_header } else { &data_header };
        let text = comment(headers, name);
        let shape = if columns == "1" { rows.to_string() } else { format!("{rows} × {columns}") };
        let length = format!("{} * ({})", size(rows), size(columns));
        let writable = matches!(element, "f64" | "f32");
        let free = if owner == "model" { FREE_IN_MODEL } else { FREE_IN_DATA }.contains(&name);
        let (reader, writer) = if owner == "model" { (&mut model, Some(&mut model_mut)) } else { (&mut data, None) };
        let bind = if owner == "model" { "let model = self.raw();" } else { "let model = self.model().raw();" };
        let _ = writeln!(
            reader,
            "    /// `{name}`, {shape}: {text}.\n    #[inline]\n    \
             pub fn {name}(&self) -> &[{element}] {{\n        {bind}\n        \
             // SAFETY: MuJoCo allocated this many elements here for as long as self lives.\n        \
             unsafe {{ view(self.raw().{name}, {length}) }}\n    }}"
        );
        if writable {
            let (keyword, terms) = if free {
                ("", "")
            } else {
                (
                    "unsafe ",
                    "    ///\n    /// # Safety\n    \
                     /// MuJoCo derives memory addresses from these numbers: every value must be one that\n    \
                     /// MuJoCo's compiler, or its last step, could have written here.\n",
                )
            };
            let _ = writeln!(
                writer.unwrap_or(reader),
                "    /// Mutable `{name}`, {shape}: {text}.\n{terms}    #[inline]\n    \
                 pub {keyword}fn {name}_mut(&mut self) -> &mut [{element}] {{\n        {bind}\n        \
                 // SAFETY: as above, and self is borrowed mutably.\n        \
                 unsafe {{ view_mut(self.raw().{name}, {length}) }}\n    }}"
            );
        }
    }

    let text = format!(
        "/// Sizes.\nimpl Model {{\n{sizes}}}\n\n/// Arrays, row-major.\nimpl Model {{\n{model}}}\n\n\
         /// Mutable arrays of numbers, row-major.\nimpl ModelMut<'_> {{\n{model_mut}}}\n\n\
         /// Arrays, row-major.\nimpl Data {{\n{data}}}\n"
    );
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::write(out.join("arrays.rs"), text).expect("OUT_DIR is writable");
}

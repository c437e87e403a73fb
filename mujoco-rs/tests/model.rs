//! Compilation, names and patches of models.

use mujoco_rs::{Assets, BodyId, CameraId, Data, Error, GeomId, Integrator, JointId, Model, ObjectKind};
use proptest::prelude::*;

const SCENE: &str = r#"<mujoco>
  <option timestep="0.005" integrator="RK4" gravity="0 0 -9.81" density="1.2" viscosity="1.8e-5"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <camera name="eye" pos="0 0 1"/>
    <body name="a" pos="0 0 1"><freejoint name="a_joint"/><geom name="a_geom" size=".1" mass="2"/></body>
    <body name="b" pos="1 0 1"><joint name="hinge" type="hinge"/><geom size=".1" mass="3"/></body>
  </worldbody>
</mujoco>"#;

#[test]
fn sizes_names_and_options_match_the_scene() {
    let model = Model::from_xml(SCENE).unwrap();
    assert_eq!((model.nbody(), model.nq(), model.nv()), (3, 8, 7));
    assert_eq!(model.timestep(), 0.005);
    assert_eq!(model.gravity(), [0.0, 0.0, -9.81]);
    assert_eq!((model.density(), model.viscosity()), (1.2, 1.8e-5));
    assert_eq!(model.integrator(), Some(Integrator::Rk4));
    assert_eq!(model.count(ObjectKind::Camera), 1);

    let a: BodyId = model.find("a").unwrap();
    assert_eq!(model.name(a), Some("a"));
    assert_eq!(model.body_mass()[a.index()], 2.0);
    let hinge: JointId = model.find("hinge").unwrap();
    assert_eq!(model.jnt_qposadr()[hinge.index()], 7);
    assert!(model.find::<CameraId>("eye").is_ok());
    let b: BodyId = model.find("b").unwrap();
    let nameless = (0..model.ngeom()).filter(|&g| model.geom_bodyid()[g] == b.index() as i32).count();
    assert_eq!(nameless, 1);
}

#[test]
fn an_unknown_name_is_an_error_with_kind_and_name() {
    let model = Model::from_xml(SCENE).unwrap();
    let error = model.find::<GeomId>("a").unwrap_err();
    assert_eq!(error, Error::UnknownName { kind: ObjectKind::Geom, name: "a".into() });
    assert_eq!(error.to_string(), "no geom named `a` in the model");
    assert!(model.find::<GeomId>("zero\0byte").is_err());
    assert!(model.find::<GeomId>("").is_err());
}

#[test]
fn every_array_has_the_length_that_mujoco_allocates() {
    let model = Model::from_xml(SCENE).unwrap();
    assert_eq!(model.qpos0().len(), 8);
    assert_eq!(model.body_inertia().len(), 9);
    assert_eq!(model.geom_solimp().len(), model.ngeom() * 5);
    assert_eq!(model.names().len(), model.nnames());
    assert_eq!(model.key_qpos().len(), 0);
    let data = Data::new(model).unwrap();
    assert_eq!(data.xfrc_applied().len(), 18);
    assert_eq!(data.efc_AR().len(), data.model().njmax() * data.model().njmax());
    assert_eq!(data.efc_J().len(), data.model().njmax() * 7);
}

#[test]
fn malformed_scenes_are_errors_with_mujocos_message() {
    let message = |xml: &str| Model::from_xml(xml).unwrap_err().to_string();
    assert!(message("<mujoco><worldbody>").contains("XML"), "{}", message("<mujoco><worldbody>"));
    assert!(message("").contains("empty"));
    assert!(message("<mujoco><worldbody><nosuch/></worldbody></mujoco>").contains("nosuch"));
    assert!(message("<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>").contains("size"));
    let no_mass = "<mujoco><worldbody><body><freejoint/></body></worldbody></mujoco>";
    assert!(message(no_mass).contains("mass"), "{}", message(no_mass));
    for xml in ["<mujoco/", "not xml", "<a/>"] {
        let text = message(xml);
        assert!(!text.contains('\n') && text.len() > 10, "{text:?}");
    }
}

#[test]
fn assets_in_memory_are_used_and_bad_ones_rejected() {
    let xml = r#"<mujoco><asset><mesh name="m" file="tetra.obj"/></asset>
        <worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>"#;
    let tetra = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    let model = Model::from_xml_with_assets(xml, &Assets::new().with("tetra.obj", tetra)).unwrap();
    assert_eq!(model.nmesh(), 1);

    let refused = |name: &str, bytes: &[u8]| {
        let error = Model::from_xml_with_assets(xml, &Assets::new().with(name, bytes)).unwrap_err();
        assert!(matches!(error, Error::Asset { .. }), "{error}");
        error.to_string()
    };
    assert!(refused("", b"x").contains("0 bytes"));
    assert!(refused(&"x".repeat(2000), b"x").contains("2000 bytes"));
    assert!(refused("a/b.obj", b"x").contains("directory"));
    assert!(refused("tetra.obj", b"").contains("empty"));
    let twice = Assets::new().with("a.obj", "x").with("a.obj", "y");
    assert!(Model::from_xml_with_assets(xml, &twice).unwrap_err().to_string().contains("already"));
    let many = (0..2100).fold(Assets::new(), |assets, i| assets.with(format!("{i}.obj"), "x"));
    assert_eq!(many.len(), 2100);
    assert!(Model::from_xml_with_assets(xml, &many).unwrap_err().to_string().contains("more than"));
    let missing = Model::from_xml(xml).unwrap_err().to_string();
    assert!(missing.contains("tetra.obj"), "{missing}");
    assert!(refused("tetra.obj", b"garbage").contains("0 vertices"));
    assert!(refused("other.obj", tetra.as_bytes()).contains("not among the assets"), "no file is read from disk");
}

#[test]
fn engine_errors_inside_the_parser_are_errors_and_release_its_lock() {
    let long = format!("<mujoco><include file='{}'/></mujoco>", "x".repeat(1200));
    let error = Model::from_xml(&long).unwrap_err().to_string();
    assert!(error.contains("1 to 999 bytes"), "{error}");
    let path = "d/".repeat(3000) + "scene.xml";
    assert!(matches!(Model::from_file(path), Err(Error::Load { .. })));
    let huge = "<mujoco><asset><hfield name='h' nrow='50000' ncol='50000' size='1 1 1 1'/></asset></mujoco>";
    assert!(Model::from_xml(huge).is_err());
    assert!(Model::from_xml(SCENE).is_ok(), "the parser's lock is free");
}

#[test]
fn files_are_loaded_by_path_and_missing_files_are_named() {
    let path = std::env::temp_dir().join(format!("mujoco-rs-model-{}.xml", std::process::id()));
    std::fs::write(&path, SCENE).unwrap();
    assert_eq!(Model::from_file(&path).unwrap().nbody(), 3);
    std::fs::remove_file(&path).unwrap();
    let message = Model::from_file(&path).unwrap_err().to_string();
    assert!(message.starts_with(&path.display().to_string()) && message.contains("No such file"), "{message}");
}

#[test]
fn patching_a_copy_does_not_change_the_original() {
    let model = Model::from_xml(SCENE).unwrap();
    let mut copy = model.try_clone().unwrap();
    copy.patch().body_mass_mut()[1] = 5.0;
    copy.patch().set_timestep(0.001).unwrap();
    copy.patch().set_gravity([0.0, 0.0, -1.0]).unwrap();
    copy.patch().set_integrator(Integrator::Euler);
    assert_eq!((copy.body_mass()[1], model.body_mass()[1]), (5.0, 2.0));
    assert_eq!((copy.timestep(), model.timestep()), (0.001, 0.005));
    assert_eq!((copy.gravity()[2], copy.integrator()), (-1.0, Some(Integrator::Euler)));
    assert!(copy.patch().set_timestep(0.0).is_err());
    assert!(copy.patch().set_timestep(f64::NAN).is_err());
    assert!(copy.patch().set_gravity([0.0, f64::INFINITY, 0.0]).is_err());
}

#[test]
fn setters_validate_numbers_that_mujoco_addresses_memory_with() {
    let xml = "<mujoco><asset><hfield name='h' nrow='2' ncol='3' size='1 1 1 1'/></asset><worldbody>
        <geom name='box' type='box' size='.1 .1 .1'/><geom name='plane' type='plane' size='1 1 1'/>
        <geom type='hfield' hfield='h'/></worldbody></mujoco>";
    let mut model = Model::from_xml(xml).unwrap();
    let (cube, plane): (GeomId, GeomId) = (model.find("box").unwrap(), model.find("plane").unwrap());
    let mut patch = model.patch();
    for bad in [-0.1, 0.0, f64::NAN, f64::INFINITY, 1e-300, 1e7] {
        let error = patch.set_geom_size(cube, [0.1, bad, 0.1]).unwrap_err();
        assert!(error.to_string().starts_with(&format!("a geom's size is {bad}, expected ")), "{error}");
        assert!(patch.set_hfield_size(0, [1.0, 1.0, bad, 1.0]).is_err(), "{bad}");
    }
    for bad in [f64::NAN, f64::INFINITY, -1e11] {
        assert!(patch.set_geom_pos(cube, [0.0, bad, 0.0]).is_err());
        assert!(patch.set_geom_rbound(cube, bad).is_err());
        assert!(patch.set_geom_quat(cube, [1.0, bad, 0.0, 0.0]).is_err());
    }
    assert!(patch.set_geom_quat(cube, [2.0, 0.0, 0.0, 0.0]).is_err());
    assert!(patch.set_geom_quat(cube, [0.0; 4]).is_err());
    assert!(patch.set_geom_size(plane, [0.0, 0.0, 1.0]).is_ok(), "an infinite plane");
    assert!(patch.set_geom_size(plane, [-1.0, 0.0, 1.0]).is_err());
    let strange = mujoco_rs::ObjectId::new(7);
    assert_eq!(
        patch.set_geom_pos(strange, [0.0; 3]),
        Err(Error::NotOfModel { kind: ObjectKind::Geom, index: 7, count: 3 })
    );
    assert!(patch.set_hfield_size(1, [1.0; 4]).is_err());
    patch.set_geom_pos(cube, [1.0, 2.0, 3.0]).unwrap();
    patch.set_geom_quat(cube, [0.0, 1.0, 0.0, 0.0]).unwrap();
    patch.set_geom_size(cube, [0.2, 0.3, 0.4]).unwrap();
    patch.set_geom_rbound(cube, 0.6).unwrap();
    patch.set_hfield_size(0, [1.0, 2.0, 3.0, 4.0]).unwrap();
    let row = cube.index();
    assert_eq!(model.geom_pos()[3 * row..][..3], [1.0, 2.0, 3.0]);
    assert_eq!(model.geom_quat()[4 * row..][..4], [0.0, 1.0, 0.0, 0.0]);
    assert_eq!(model.geom_size()[3 * row..][..3], [0.2, 0.3, 0.4]);
    assert_eq!((model.geom_rbound()[row], model.hfield_size()), (0.6, &[1.0, 2.0, 3.0, 4.0][..]));
}

/// Scenes for which MuJoCo's parser or compiler would access invalid memory or loop forever.
#[test]
fn scenes_that_would_crash_the_compiler_are_errors_with_their_line() {
    let asset = |inner: &str| format!("<mujoco>\n<asset>\n{inner}</asset></mujoco>");
    let geom = |inner: &str| format!("<mujoco><worldbody>\n\n<geom {inner}/></worldbody></mujoco>");
    let square = "0 0 0 1 0 0 0 1 0 0 0 1";
    for (xml, found) in [
        (asset(&format!("<mesh name='m' vertex='{square}' face='0 1 2 0 1 99'/>")), "face of <mesh> is `99`"),
        (asset(&format!("<mesh name='m' vertex='{square}' face='0 1 -1'/>")), "face of <mesh> is `-1`"),
        (asset("<mesh name='m' vertex='0 0 0 1 0 0'/>"), "vertex of <mesh> is `2 points`"),
        (asset("<mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 nan'/>"), "vertex of <mesh> is `nan`"),
        (asset("<skin name='s' vertex='0 0 0 1 0 0 0 1 0' face='0 1 7'/>"), "face of <skin> is `7`"),
        (asset("<hfield name='h' nrow='65536' ncol='65536' size='1 1 1 1'/>"), "65536 rows"),
        (asset("<hfield name='h' nrow='5' ncol='4' size='1 1 1 1'/>"), "5 rows and 4 columns"),
        (asset("<hfield name='h' nrow='1' ncol='4' size='1 1 1 1'/>"), "nrow of <hfield> is `1`"),
        (asset("<hfield name='h' nrow='4' ncol='4' size='1 1 inf 1'/>"), "size of <hfield> is `inf`"),
        (asset("<texture name='t' type='2d' builtin='flat' width='65536' height='65536'/>"), "width of <texture>"),
        (asset("<texture name='t' file='a.png' gridsize='65536 65536'/>"), "gridsize of <texture>"),
        (geom("type='box' size='nan 1 1'"), "size of <geom> is `nan`"),
        (geom("type='box' size='1e400 1 1'"), "size of <geom> is `1e400`"),
        (geom("type='box' size='1 1e-320 1'"), "size of <geom> is `1e-320`"),
        (geom("type='box' size='1 1e9 1'"), "size of <geom> is `1e9`"),
        (geom("size='1' pos='0 0 1e15'"), "pos of <geom> is `1e15`"),
        (geom("size='1' quat='1 0 0 1e200'"), "quat of <geom> is `1e200`"),
        (
            "<mujoco>\n<custom>\n<numeric name='n' size='1000' data='1'/></custom></mujoco>".into(),
            "size of <numeric> is `1000`",
        ),
        (
            format!("<mujoco>\n<custom>\n<numeric name='n' data='{}'/></custom></mujoco>", "1 ".repeat(501)),
            "data of <numeric>",
        ),
        ("<mujoco>\n\n<size nkey='2000000000'/></mujoco>".into(), "nkey of <size>"),
        ("<mujoco>\n\n<option mpr_tolerance='-1'/></mujoco>".into(), "mpr_tolerance of <option>"),
    ] {
        let message = Model::from_xml(&xml).unwrap_err().to_string();
        assert!(message.starts_with("scene: line 3: ") && message.contains(found), "{xml}: {message}");
    }
    let deep = |n: usize| {
        format!("<mujoco><worldbody>{}{}</worldbody></mujoco>", "<body><geom size='1'/>".repeat(n), "</body>".repeat(n))
    };
    assert!(Model::from_xml(&deep(100_000)).unwrap_err().to_string().contains("deep"));
    assert!(Model::from_xml(&deep(90)).is_ok());
}

#[test]
fn files_that_would_crash_the_compiler_are_errors_with_their_name() {
    fn with(name: &str, element: &str, bytes: impl Into<Vec<u8>>) -> Result<Model, Error> {
        let xml = format!("<mujoco><asset><{element} file='{name}'/></asset></mujoco>");
        Model::from_xml_with_assets(&xml, &Assets::new().with(name, bytes))
    }
    let bytes = |numbers: &[i32]| numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let floats = |numbers: &[f32]| numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let corner = floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    let msh = |face: i32| [bytes(&[4, 0, 0, 2]), corner.clone(), bytes(&[0, 2, 1, 0, 1, face])].concat();
    let png = |width: u32, height: u32| {
        let mut file = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR".to_vec();
        file.extend([width.to_be_bytes(), height.to_be_bytes()].concat());
        file
    };
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\n\
               f 1//1 3//1 2//1\nf 1//1 2//1 4//1\nf 1//1 4//1 3//1\nf 2//1 3//1 4//1\n";
    with("m.obj", "mesh", obj).unwrap();
    with("m.msh", "mesh", msh(3)).unwrap();
    let cases: [(&str, &str, Vec<u8>, &str); 14] = [
        ("m.obj", "mesh", obj.replace("f 1//1 2//1 4//1", "f 1 2 4").into(), "line 7: corner `1` names no normal"),
        (
            "m.obj",
            "mesh",
            obj.replace("f 1//1 2//1 4//1", "f 1//1 2//1 9//1").into(),
            "names vertex `9`, the file has 4",
        ),
        ("m.obj", "mesh", obj.replace("f 1//1 2//1 4//1", "# \rf 1//1 2//1 9//1").into(), "names vertex `9`"),
        ("m.obj", "mesh", obj.replace("f 1//1 2//1 4//1", "f 1//1 2//1 -9//1").into(), "names vertex `-9`"),
        ("m.obj", "mesh", obj.replace("v 0 0 1\n", "v 0 0 inf\n").into(), "line 4: `inf`"),
        ("m.obj", "mesh", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n".into(), "4 vertices and 0 faces"),
        ("m.msh", "mesh", msh(4), "names vertex 4, the file has 4"),
        ("m.msh", "mesh", bytes(&[i32::MAX, 0, 0, 0]), "the number of vertices is 2147483647"),
        ("m.stl", "mesh", vec![0; 84], "0 triangles in 0 bytes"),
        ("m.txt", "mesh", obj.into(), "expected a mesh file"),
        ("s.skn", "skin", [bytes(&[1, 0, 1, 0]), floats(&[0.0; 3]), bytes(&[0, 0, 1])].concat(), "names vertex 1"),
        ("t.png", "texture type='2d'", png(65536, 65536), "65536 by 65536"),
        ("h.png", "hfield size='1 1 1 1'", png(3, 4), "4 rows and 3 columns"),
        ("h.bin", "hfield size='1 1 1 1'", [bytes(&[2, 2]), floats(&[0.0, 1.0, f32::NAN, 0.0])].concat(), "NaN"),
    ];
    for (name, element, bytes, found) in cases {
        let error = with(name, element, bytes).unwrap_err();
        assert!(
            matches!(&error, Error::Asset { name: of, reason } if of == name && reason.contains(found)),
            "{found}: {error}"
        );
    }
}

/// Validation rewrites the text; names, texts and line numbers are preserved.
#[test]
fn validation_preserves_the_meaning_of_a_scene() {
    let xml = "<?xml version='1.0'?>\n<!-- a <comment> -->\n<mujoco model=\"a&amp;b &lt;c&gt;\">\n<worldbody>\n\
        <body name='x &quot;y&quot; \u{e4}'>
        <freejoint/><geom size='\n.1\n'/></body></worldbody>text<![CDATA[more]]></mujoco>\n";
    let model = Model::from_xml(xml).unwrap();
    assert!(model.find::<BodyId>("x \"y\" \u{e4}").is_ok());
    assert_eq!(model.geom_size()[0], 0.1);
    let error = Model::from_xml("<mujoco>\n\n<worldbody>\n  <geom\n\n size='1' nosuch='1'/>\n</worldbody></mujoco>")
        .unwrap_err();
    assert!(error.to_string().contains("nosuch") && error.to_string().contains("line 4"), "{error}");
    for xml in
        ["<mujoco/><mujoco/>", "<!DOCTYPE x><mujoco/>", "<mujoco a='1' a='2'/>", "<robot/>", "<mujoco><a></b></mujoco>"]
    {
        assert!(Model::from_xml(xml).unwrap_err().to_string().starts_with("scene: XML error at line 1: "), "{xml}");
    }
}

#[test]
fn a_scene_file_loads_the_files_that_it_refers_to() {
    let directory = std::env::temp_dir().join(format!("mujoco-rs-scene-{}", std::process::id()));
    std::fs::create_dir_all(directory.join("meshes")).unwrap();
    let write = |name: &str, text: &str| std::fs::write(directory.join(name), text).unwrap();
    write(
        "scene.xml",
        "<mujoco><compiler meshdir='meshes'/><include file='assets.xml'/>
        <worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>",
    );
    write("assets.xml", "<mujoco><asset><mesh name='m' file='Tetra.obj'/></asset></mujoco>");
    write("meshes/Tetra.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf -3 -2 -1\n");
    let load = || Model::from_file(directory.join("scene.xml"));
    assert_eq!(load().unwrap().mesh_facenum(), [4]);
    write("meshes/Tetra.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 5\n");
    let error = load().unwrap_err().to_string();
    assert!(error.starts_with("asset `Tetra.obj`: line 5: "), "{error}");
    std::fs::remove_file(directory.join("meshes/Tetra.obj")).unwrap();
    let error = load().unwrap_err().to_string();
    assert!(error.contains("meshes/Tetra.obj: No such file"), "{error}");
    std::fs::remove_dir_all(&directory).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    /// Arbitrary bytes in a scene give a model or an error, and never end the process.
    #[test]
    fn damaged_scenes_are_models_or_errors(cut in 0usize..SCENE.len(), at in 0usize..SCENE.len(), letter in 32u8..127) {
        let mut bytes = SCENE.as_bytes().to_vec();
        bytes[at] = letter;
        if let Ok(text) = std::str::from_utf8(&bytes[..cut]) {
            prop_assert!(Model::from_xml(text).is_err());
        }
        if let Ok(text) = std::str::from_utf8(&bytes)
            && let Ok(model) = Model::from_xml(text)
        {
            prop_assert!(model.nbody() >= 1);
        }
    }

    #[test]
    fn arbitrary_text_is_a_model_or_an_error(text in "\\PC{0,200}") {
        if let Err(error) = Model::from_xml(&text) {
            prop_assert!(!error.to_string().is_empty());
        }
    }
}

/// Limits apply to nesting, to each mesh and to each file, not to sums over a scene.
#[test]
fn limits_apply_to_each_part_and_not_to_sums_over_a_scene() {
    // 15 includes side by side, each 25 deep
    let deep = format!("<mujocoinclude>{}{}</mujocoinclude>", "<body>".repeat(24), "</body>".repeat(24));
    let include = |name: &str| format!("<include file='{name}'/>");
    let scene = |inside: &str| format!("<mujoco><worldbody>{inside}</worldbody></mujoco>");
    let names: Vec<_> = (0..15).map(|i| format!("part{i}.xml")).collect();
    let assets = names.iter().fold(Assets::new(), |assets, name| assets.with(name, deep.clone()));
    let xml = scene(&names.iter().map(|name| include(name)).collect::<String>());
    assert_eq!(Model::from_xml_with_assets(&xml, &assets).unwrap().nbody(), 1 + 15 * 24);
    // the same includes nested
    let nested = |i: usize| {
        let inner = if i < 14 { include(&format!("part{}.xml", i + 1)) } else { String::new() };
        format!("<mujocoinclude>{}{inner}{}</mujocoinclude>", "<body>".repeat(24), "</body>".repeat(24))
    };
    let assets = (0..15).fold(Assets::new(), |assets, i| assets.with(format!("part{i}.xml"), nested(i)));
    let error = Model::from_xml_with_assets(&scene(&include("part0.xml")), &assets).unwrap_err().to_string();
    assert!(error.contains("more than 200 deep"), "{error}");

    // a mesh in km scaled to m, and one in mm scaled up
    let tetra =
        |size: f64| format!("v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n");
    let assets = Assets::new().with("large.obj", tetra(1e5)).with("small.obj", tetra(1e-2));
    let meshes = |large: &str, small: &str| {
        format!(
            "<mujoco><asset><mesh name='l' file='large.obj' {large}/><mesh name='s' file='small.obj' {small}/></asset>
            <worldbody><geom type='mesh' mesh='l'/><geom type='mesh' mesh='s'/></worldbody></mujoco>"
        )
    };
    let load = |large: &str, small: &str| Model::from_xml_with_assets(&meshes(large, small), &assets);
    assert_eq!(load("", "scale='1000 1000 1000'").unwrap().nmesh(), 2);
    for (large, small) in [("scale='1 1 100'", ""), ("class='far'", "")] {
        let xml = meshes(large, small)
            .replace("<asset>", "<default><default class='far'><mesh scale='1 100 1'/></default></default><asset>");
        let error = Model::from_xml_with_assets(&xml, &assets).unwrap_err().to_string();
        assert!(error.contains("a mesh reaches 10000000 m"), "{error}");
    }
    // one file, two meshes
    let xml = meshes("", "").replace("small.obj", "large.obj").replace("name='s'", "name='s' scale='1 1 100'");
    let error = Model::from_xml_with_assets(&xml, &assets).unwrap_err().to_string();
    assert!(error.contains("a mesh reaches 10000000 m"), "{error}");
}

#[test]
fn one_image_serves_as_height_field_and_as_texture() {
    let png = |columns: u32, rows: u32| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let image = image::GrayImage::from_fn(columns, rows, |x, y| image::Luma([(40 * x + 3 * y) as u8]));
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    };
    let xml = "<mujoco><asset><hfield name='h' file='ground.png' size='1 1 1 1'/>
        <texture name='t' type='2d' file='ground.png'/></asset>
        <worldbody><geom type='hfield' hfield='h'/></worldbody></mujoco>";
    let model = Model::from_xml_with_assets(xml, &Assets::new().with("ground.png", png(6, 4))).unwrap();
    assert_eq!((model.nhfield(), model.ntex()), (1, 1));

    // two files of the same name
    let directory = std::env::temp_dir().join(format!("mujoco-rs-two-{}", std::process::id()));
    for (name, size) in [("a", 5), ("b", 6)] {
        std::fs::create_dir_all(directory.join(name)).unwrap();
        std::fs::write(directory.join(name).join("ground.png"), png(size, 4)).unwrap();
    }
    let path = directory.join("scene.xml");
    std::fs::write(&path, xml.replace("ground.png", "a/ground.png").replacen("a/", "b/", 1)).unwrap();
    let error = Model::from_file(&path).unwrap_err().to_string();
    std::fs::remove_dir_all(&directory).unwrap();
    assert!(error.contains("`a/ground.png`") && error.contains("`b/ground.png`"), "{error}");
}

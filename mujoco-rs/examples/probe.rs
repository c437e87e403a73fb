//! probe
use mujoco_rs::*;
use std::time::Instant;
fn main() -> Result<(), Error> {
    println!("{:?}", gl_info()?);
    let xml = r#"<mujoco><visual><map znear="0.01" zfar="100"/></visual><statistic extent="1" center="0 0 0"/><worldbody>
    <light directional="true" dir="0 0 -1" pos="0 0 5"/>
    <geom name="floor" type="plane" size="50 50 50" rgba=".4 .5 .6 1"/>
    <body pos="1 0 .5"><geom name="box" type="box" size=".1 .1 .1" rgba="1 0 0 1"/></body>
    <camera name="eye" pos="0 0 .5" xyaxes="0 -1 0 0 0 1" fovy="60"/></worldbody></mujoco>"#;
    let mut data = Data::new(Model::from_xml(xml)?)?;
    data.kinematics()?;
    let model = data.shared_model();
    let cam = Camera::Fixed(model.find("eye")?);
    let size = ImageSize { width: 64, height: 48 };
    let mut scene = Scene::new(model.clone(), 10)?;
    scene.set_effects(Effects::default());
    let mut r = Renderer::new(model.clone(), Quality::FAST)?;
    scene.update(&mut data, &cam)?;
    let mut rgb = vec![0; 3 * size.pixels()];
    let mut depth = vec![0.0; size.pixels()];
    let mut seg = vec![[0; 2]; size.pixels()];
    for name in ["rgb", "depth", "seg"] {
        for _ in 0..2 {
            let t = Instant::now();
            for _ in 0..2000 {
                scene.update(&mut data, &cam)?;
                match name {
                    "rgb" => r.rgb(&mut scene, size, &mut rgb)?,
                    "depth" => r.depth(&mut scene, size, &mut depth)?,
                    _ => r.segmentation(&mut scene, size, &mut seg)?,
                }
            }
            println!("{name} {:.0}/s", 2000.0 / t.elapsed().as_secs_f64());
        }
    }
    println!(
        "centre {:?} depth {} seg {:?} top {:?} seg {:?} bottom {} {:?}",
        &rgb[3 * (24 * 64 + 32)..][..3],
        depth[24 * 64 + 32],
        seg[24 * 64 + 32],
        &rgb[..3],
        seg[0],
        depth[47 * 64 + 32],
        seg[47 * 64 + 32]
    );
    for n in [1, 2, 1, 2] {
        let t = Instant::now();
        std::thread::scope(|s| {
            for _ in 0..n {
                let model = model.clone();
                s.spawn(move || {
                    let size = ImageSize { width: 64, height: 48 };
                    let mut data = Data::new(model.clone()).unwrap();
                    data.kinematics().unwrap();
                    let mut scene = Scene::new(model.clone(), 10).unwrap();
                    scene.set_effects(Effects::default());
                    let mut r = Renderer::new(model.clone(), Quality::FAST).unwrap();
                    let mut rgb = vec![0; 3 * size.pixels()];
                    for _ in 0..40000 {
                        scene.update(&mut data, &cam).unwrap();
                        r.rgb(&mut scene, size, &mut rgb).unwrap();
                    }
                });
            }
        });
        println!("{n} threads {:.0}/s", 40000.0 * n as f64 / t.elapsed().as_secs_f64());
    }
    Ok(())
}

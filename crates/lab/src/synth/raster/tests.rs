use super::super::paint::Painting;
use super::*;

fn upright(left: Vec3, right: Vec3, height: f32, texture: Arc<Texture>) -> Quad {
    let origin = left + Vec3::new(0.0, height, 0.0);
    let down = Vec3::new(0.0, -height, 0.0);
    Quad {
        origin,
        across: right - left,
        down,
        texture,
        surface: Surface::Wall,
        cutout: false,
    }
}

/// Left half red, right half green, upper quarter blue.
fn quad() -> Quad {
    let mut painting = Painting::new(4.0, 4.0, 32.0);
    painting.rect(0.0, 0.0, 2.0, 4.0, [255, 0, 0]);
    painting.rect(2.0, 0.0, 2.0, 4.0, [0, 255, 0]);
    painting.rect(0.0, 0.0, 4.0, 1.0, [0, 0, 255]);
    let texture = Arc::new(Texture::new(&painting));
    upright(
        Vec3::new(6.0, 0.0, -2.0),
        Vec3::new(8.0, 0.0, 1.464),
        4.0,
        texture,
    )
}

fn camera() -> Camera {
    Camera::new(Vec3::new(0.0, 1.6, 0.3), 0.1, 0.05, 0.02, 320, 240)
}

fn project(camera: &Camera, point: Vec3) -> [f32; 2] {
    camera.on_image(camera.view(point))
}

#[test]
fn pixels_map_back_to_the_points_projected_on_them() {
    let quad = quad();
    let camera = camera();
    let map = PixelToQuad::new(&camera, &quad).unwrap();
    for (u, v) in [(0.01, 0.01), (0.5, 0.5), (0.9, 0.2), (0.3, 0.99)] {
        let point = quad.origin + quad.across * u + quad.down * v;
        let [x, y] = project(&camera, point);
        let (found_u, found_v, inverse_depth) = map.at(x, y).unwrap();
        assert!((found_u - u).abs() < 1e-3 && (found_v - v).abs() < 1e-3);
        assert!((1.0 / inverse_depth - camera.view(point).z).abs() < 1e-2);
    }
}

#[test]
fn what_is_drawn_lies_where_it_projects_and_the_nearer_wins() {
    let far = quad();
    let camera = camera();
    let mut wall = Painting::new(1.0, 1.0, 8.0);
    wall.rect(0.0, 0.0, 1.0, 1.0, [255, 255, 255]);
    let near = upright(
        Vec3::new(4.0, 0.0, 0.0),
        Vec3::new(4.0, 0.0, 1.0),
        1.0,
        Arc::new(Texture::new(&wall)),
    );
    let mut frame = Frame::new(&camera);
    frame.draw(&camera, &[near.clone(), far.clone()], &|fragment| {
        fragment.albedo
    });
    let at = |quad: &Quad, u: f32, v: f32| {
        let [x, y] = project(&camera, quad.origin + quad.across * u + quad.down * v);
        frame.light[y as usize * camera.width + x as usize].map(|channel| channel > 0.5)
    };
    assert_eq!(at(&far, 0.1, 0.5), [true, false, false]);
    assert_eq!(at(&far, 0.9, 0.5), [false, true, false]);
    assert_eq!(at(&far, 0.4, 0.1), [false, false, true]);
    assert_eq!(at(&near, 0.5, 0.5), [true, true, true]);
    assert!(frame.depth(0).is_infinite());
}

#[test]
fn quads_behind_or_edge_on_draw_nothing_and_crossing_ones_are_cut() {
    let camera = Camera::new(Vec3::zeros(), 0.0, 0.0, 0.0, 64, 48);
    let texture = quad().texture;
    let behind = upright(
        Vec3::new(-3.0, -1.0, -1.0),
        Vec3::new(-3.0, -1.0, 1.0),
        2.0,
        texture.clone(),
    );
    let edge_on = upright(
        Vec3::new(1.0, -1.0, 0.0),
        Vec3::new(3.0, -1.0, 0.0),
        2.0,
        texture.clone(),
    );
    let mut frame = Frame::new(&camera);
    frame.draw(&camera, &[behind, edge_on], &|_| [1.0; 3]);
    assert!(frame.light.iter().all(|light| *light == [0.0; 3]));
    let passing = upright(
        Vec3::new(-5.0, -1.0, 1.0),
        Vec3::new(50.0, -1.0, 1.0),
        2.0,
        texture,
    );
    frame.draw(&camera, &[passing], &|_| [1.0; 3]);
    let lit = |x: usize| frame.light[24 * 64 + x] == [1.0; 3];
    assert!(
        lit(63) && lit(40) && !lit(30),
        "the wall fills the right of the picture"
    );
}

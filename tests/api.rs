//! What the crates offer, as a list that shows in a review: every public item, without its body.
//!
//! After an intended change, `INSTA_UPDATE=always cargo test --test api` writes `tests/snapshots/api__*.snap` anew.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use syn::{
    Attribute, Field, Fields, File, ImplItem, Item, ItemImpl, TraitItem, Type, UseTree, Visibility,
    parse_quote,
};

/// The items of one module, and those of the modules in it.
struct Module {
    path: String,
    /// Whether everything public in it is public outside; else only what is used elsewhere publicly.
    open: bool,
    items: Vec<Item>,
}

fn read(file: &Path) -> Vec<Item> {
    let text = fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display())).items
}

/// The file of a module without a body.
fn file_of(folder: &Path, name: &str) -> PathBuf {
    let flat = folder.join(format!("{name}.rs"));
    if flat.exists() { flat } else { folder.join(name).join("mod.rs") }
}

fn is_public(visibility: &Visibility) -> bool {
    matches!(visibility, Visibility::Public(_))
}

fn is_for_tests(attributes: &[Attribute]) -> bool {
    attributes
        .iter()
        .any(|a| a.path().is_ident("cfg") && a.parse_args::<syn::Path>().is_ok_and(|p| p.is_ident("test")))
}

fn walk(items: Vec<Item>, folder: &Path, path: &str, open: bool, out: &mut Vec<Module>) {
    let mut own = Vec::new();
    let mut inner = Vec::new();
    for item in items {
        match item {
            Item::Mod(module) if is_for_tests(&module.attrs) => {}
            Item::Mod(module) => inner.push(module),
            item => own.push(item),
        }
    }
    out.push(Module { path: path.into(), open, items: own });
    for module in inner {
        let name = module.ident.to_string();
        let items = match module.content {
            Some((_, items)) => items,
            None => read(&file_of(folder, &name)),
        };
        walk(items, &folder.join(&name), &format!("{path}::{name}"), open && is_public(&module.vis), out);
    }
}

/// The names that a `use` brings.
fn names(tree: &UseTree, out: &mut BTreeSet<String>) {
    match tree {
        UseTree::Path(path) => names(&path.tree, out),
        UseTree::Name(name) => drop(out.insert(name.ident.to_string())),
        UseTree::Rename(rename) => drop(out.insert(rename.ident.to_string())),
        UseTree::Group(group) => group.items.iter().for_each(|tree| names(tree, out)),
        UseTree::Glob(_) => {}
    }
}

/// An item's name and visibility, where it has both.
fn head(item: &Item) -> Option<(String, &Visibility)> {
    Some(match item {
        Item::Const(i) => (i.ident.to_string(), &i.vis),
        Item::Enum(i) => (i.ident.to_string(), &i.vis),
        Item::Fn(i) => (i.sig.ident.to_string(), &i.vis),
        Item::Static(i) => (i.ident.to_string(), &i.vis),
        Item::Struct(i) => (i.ident.to_string(), &i.vis),
        Item::Trait(i) => (i.ident.to_string(), &i.vis),
        Item::Type(i) => (i.ident.to_string(), &i.vis),
        _ => return None,
    })
}

/// Of the attributes those that say what a user may do.
fn kept(attributes: &mut Vec<Attribute>) {
    attributes
        .retain(|a| ["derive", "cfg", "non_exhaustive", "repr"].iter().any(|name| a.path().is_ident(name)));
}

fn strip_fields(fields: &mut Fields) {
    let strip = |field: &mut Field| kept(&mut field.attrs);
    match fields {
        Fields::Named(named) => {
            named.named = named.named.clone().into_iter().filter(|f| is_public(&f.vis)).collect();
            named.named.iter_mut().for_each(strip);
        }
        Fields::Unnamed(unnamed) => {
            for field in &mut unnamed.unnamed {
                strip(field);
                if !is_public(&field.vis) {
                    field.ty = parse_quote!(_);
                }
            }
        }
        Fields::Unit => {}
    }
}

/// The name of the type that an `impl` is of.
fn subject(of: &ItemImpl) -> Option<String> {
    let mut ty = &*of.self_ty;
    while let Type::Reference(reference) = ty {
        ty = &reference.elem;
    }
    match ty {
        Type::Path(path) => path.path.segments.last().map(|s| s.ident.to_string()),
        _ => None,
    }
}

/// The `impl` as a user sees it; none where there is nothing to see.
fn strip_impl(mut of: ItemImpl) -> Option<Item> {
    kept(&mut of.attrs);
    let inherent = of.trait_.is_none();
    of.items.retain_mut(|item| match item {
        ImplItem::Fn(f) => {
            f.attrs.clear();
            f.block = parse_quote!({});
            inherent && is_public(&f.vis)
        }
        ImplItem::Const(c) => {
            c.attrs.clear();
            c.expr = parse_quote!(..);
            inherent && is_public(&c.vis)
        }
        ImplItem::Type(t) => {
            t.attrs.clear();
            true
        }
        _ => false,
    });
    (!inherent || !of.items.is_empty()).then_some(Item::Impl(of))
}

fn strip(item: Item) -> Item {
    match item {
        Item::Fn(mut i) => {
            kept(&mut i.attrs);
            i.block = parse_quote!({});
            Item::Fn(i)
        }
        Item::Const(mut i) => {
            kept(&mut i.attrs);
            i.expr = parse_quote!(..);
            Item::Const(i)
        }
        Item::Static(mut i) => {
            kept(&mut i.attrs);
            i.expr = parse_quote!(..);
            Item::Static(i)
        }
        Item::Struct(mut i) => {
            kept(&mut i.attrs);
            strip_fields(&mut i.fields);
            Item::Struct(i)
        }
        Item::Enum(mut i) => {
            kept(&mut i.attrs);
            for variant in &mut i.variants {
                kept(&mut variant.attrs);
                variant.fields.iter_mut().for_each(|field| field.attrs.clear());
            }
            Item::Enum(i)
        }
        Item::Trait(mut i) => {
            kept(&mut i.attrs);
            for item in &mut i.items {
                match item {
                    TraitItem::Fn(f) => {
                        f.attrs.clear();
                        f.default = f.default.take().map(|_| parse_quote!({}));
                    }
                    TraitItem::Const(c) => c.attrs.clear(),
                    TraitItem::Type(t) => t.attrs.clear(),
                    _ => {}
                }
            }
            Item::Trait(i)
        }
        Item::Type(mut i) => {
            kept(&mut i.attrs);
            Item::Type(i)
        }
        Item::Use(mut i) => {
            kept(&mut i.attrs);
            Item::Use(i)
        }
        other => other,
    }
}

/// Everything public of the crate in `folder`, module by module.
fn listing(folder: &str, name: &str) -> String {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder).join("src");
    let mut modules = Vec::new();
    walk(read(&source.join("lib.rs")), &source, name, true, &mut modules);
    let mut used = BTreeSet::new();
    for item in modules.iter().flat_map(|module| &module.items) {
        if let Item::Use(item) = item
            && is_public(&item.vis)
        {
            names(&item.tree, &mut used);
        }
    }
    let shown = |open: bool, item: &Item| match item {
        Item::Use(item) => open && is_public(&item.vis),
        Item::Macro(item) => item.attrs.iter().any(|a| a.path().is_ident("macro_export")),
        item => head(item)
            .is_some_and(|(name, visibility)| is_public(visibility) && (open || used.contains(&name))),
    };
    let public: BTreeSet<String> = modules
        .iter()
        .flat_map(|module| module.items.iter().filter(|item| shown(module.open, item)).filter_map(head))
        .map(|(name, _)| name)
        .collect();
    let mut text = String::new();
    for module in modules {
        let mut items = Vec::new();
        for item in module.items {
            match item {
                Item::Impl(of) if subject(&of).is_some_and(|name| public.contains(&name)) => {
                    items.extend(strip_impl(of))
                }
                Item::Impl(_) => {}
                Item::Macro(item) if shown(module.open, &Item::Macro(item.clone())) => {
                    let name = item.ident.map(|ident| ident.to_string()).unwrap_or_default();
                    text += &format!("// {}\nmacro_rules! {name}\n", module.path);
                }
                item if shown(module.open, &item) => items.push(strip(item)),
                _ => {}
            }
        }
        if !items.is_empty() {
            let file = File { shebang: None, attrs: Vec::new(), items };
            text += &format!("// {}\n{}\n", module.path, prettyplease::unparse(&file));
        }
    }
    text
}

macro_rules! crates {
    ($($test:ident: $folder:literal, $name:literal;)*) => {$(
        #[test]
        fn $test() {
            insta::with_settings!({ omit_expression => true, description => "public items" }, {
                insta::assert_snapshot!($name, listing($folder, $name));
            });
        }
    )*};
}

crates! {
    the_models: "model", "parallax_model";
    the_runtime: "runtime", "parallax_runtime";
    the_simulated_clock: "sim", "parallax_sim";
    the_nodes: "nodes", "parallax_nodes";
    the_diagnosis: "gap", "parallax_gap";
    the_program: ".", "parallax";
}

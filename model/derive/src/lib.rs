//! Derives `parallax_model::tree::Tree` for structs of scalars.
//!
//! - `struct State<T> { angle: T, speed: T }` becomes a tree over any scalar `T`.
//! - `struct Reading { angle: f64 }` (no type parameter) becomes a tree over `f64`.
//! - `struct Nothing;` becomes a tree without leaves, over any scalar.
//!
//! Fields may be scalars, other trees, and arrays of either. A name that a ROS 2 message could not carry is a
//! compile error, because recordings use the same names.

use std::collections::BTreeSet;

use proc_macro2::TokenStream;
use quote::{ToTokens, format_ident, quote, quote_spanned};
use syn::ext::IdentExt;
use syn::spanned::Spanned;
use syn::{Data, DeriveInput, Error, Field, Fields, GenericParam, Ident, Result, Type, parse_macro_input};

/// Derives `Tree`: a flat list of named leaves, and back.
///
/// # Errors
///
/// Does not compile for an enum, a union, a struct with unnamed fields, one with several type parameters or with
/// lifetimes, and for a field whose name is not lowercase letters, digits and single underscores.
#[proc_macro_derive(Tree)]
pub fn derive_tree(input: proc_macro::TokenStream) -> proc_macro::TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    expand(&input).unwrap_or_else(Error::into_compile_error).into()
}

fn expand(input: &DeriveInput) -> Result<TokenStream> {
    let fields = named_fields(input)?;
    check_names(&fields)?;
    let scalar = scalar_of(input, &fields)?;

    let name = &input.ident;
    let (_, type_generics, where_clause) = input.generics.split_for_impl();
    let mut generics = input.generics.clone();
    let leaf: TokenStream = match &scalar {
        ScalarType::Parameter(parameter) => {
            for candidate in generics.type_params_mut() {
                candidate.bounds.push(syn::parse_quote!(::parallax_model::Scalar));
            }
            parameter.to_token_stream()
        }
        ScalarType::F64 => quote!(f64),
        ScalarType::Any => {
            let any = format_ident!("ParallaxScalar");
            generics.params.push(syn::parse_quote!(#any: ::parallax_model::Scalar));
            any.to_token_stream()
        }
    };
    let (impl_generics, _, _) = generics.split_for_impl();

    let idents: Vec<&Ident> = fields.iter().filter_map(|field| field.ident.as_ref()).collect();
    let labels: Vec<String> = idents.iter().map(|ident| ident.unraw().to_string()).collect();
    // Spanned at the field's type, so that "does not implement Tree" points there.
    let trees: Vec<TokenStream> = fields
        .iter()
        .map(|field| {
            let ty = &field.ty;
            quote_spanned!(ty.span()=> <#ty as ::parallax_model::tree::Tree<#leaf>>)
        })
        .collect();

    Ok(quote! {
        #[automatically_derived]
        impl #impl_generics ::parallax_model::tree::Tree<#leaf> for #name #type_generics #where_clause {
            const LEAVES: usize = 0 #(+ #trees::LEAVES)*;

            fn names(prefix: &str, out: &mut ::std::vec::Vec<::std::string::String>) {
                let _ = (prefix, &out);
                #(#trees::names(&::parallax_model::tree::join(prefix, #labels), out);)*
            }

            #[inline(always)]
            fn visit(&self, leaf: &mut impl ::core::ops::FnMut(#leaf)) {
                let _ = &leaf;
                #(#trees::visit(&self.#idents, leaf);)*
            }

            #[inline(always)]
            fn build(next: &mut impl ::core::ops::FnMut() -> #leaf) -> Self {
                let _ = &next;
                Self { #(#idents: #trees::build(next),)* }
            }

            #[inline(always)]
            fn zip(&self, other: &Self, combine: &mut impl ::core::ops::FnMut(#leaf, #leaf) -> #leaf) -> Self {
                let _ = (other, &combine);
                Self { #(#idents: #trees::zip(&self.#idents, &other.#idents, combine),)* }
            }
        }
    })
}

/// What the leaves of the struct are.
enum ScalarType {
    Parameter(Ident),
    F64,
    Any,
}

fn scalar_of(input: &DeriveInput, fields: &[&Field]) -> Result<ScalarType> {
    let mut parameter = None;
    for generic in &input.generics.params {
        match generic {
            GenericParam::Type(ty) if parameter.is_none() => parameter = Some(ty.ident.clone()),
            GenericParam::Type(ty) => {
                return Err(Error::new(
                    ty.span(),
                    "Tree: one type parameter only, the scalar of all leaves; write nested trees as `Inner<T>`",
                ));
            }
            GenericParam::Lifetime(lifetime) => {
                return Err(Error::new(lifetime.span(), "Tree: a tree owns its leaves, it cannot borrow"));
            }
            GenericParam::Const(_) => {}
        }
    }
    Ok(match parameter {
        Some(ident) => ScalarType::Parameter(ident),
        None if fields.is_empty() => ScalarType::Any,
        None => ScalarType::F64,
    })
}

fn named_fields(input: &DeriveInput) -> Result<Vec<&Field>> {
    let Data::Struct(data) = &input.data else {
        return Err(Error::new(
            input.ident.span(),
            "Tree: only a struct has a fixed list of leaves; write a choice as a number and `select`",
        ));
    };
    match &data.fields {
        Fields::Named(named) => Ok(named.named.iter().collect()),
        Fields::Unit => Ok(Vec::new()),
        Fields::Unnamed(unnamed) => Err(Error::new(
            unnamed.span(),
            "Tree: every leaf needs a name; write `struct Name { field: T }` instead of `struct Name(T)`",
        )),
    }
}

/// Leaves become fields of ROS 2 messages in a recording, so their names must be legal there and distinct.
fn check_names(fields: &[&Field]) -> Result<()> {
    let names: BTreeSet<String> = fields
        .iter()
        .filter_map(|field| field.ident.as_ref())
        .map(|ident| ident.unraw().to_string())
        .collect();
    for field in fields {
        let Some(ident) = &field.ident else { continue };
        let name = ident.unraw().to_string();
        let legal = name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
            && !name.ends_with('_')
            && !name.contains("__");
        if !legal {
            return Err(Error::new(
                ident.span(),
                format!(
                    "Tree: `{name}` cannot name a field of a recorded message; \
                     use lowercase letters, digits and single underscores, starting with a letter"
                ),
            ));
        }
        if matches!(field.ty, Type::Array(_)) {
            let clash = names.iter().find(|other| {
                other
                    .strip_prefix(name.as_str())
                    .and_then(|rest| rest.strip_prefix('_'))
                    .is_some_and(|index| !index.is_empty() && index.chars().all(|c| c.is_ascii_digit()))
            });
            if let Some(clash) = clash {
                return Err(Error::new(
                    ident.span(),
                    format!(
                        "Tree: the elements of `{name}` are named `{name}_0`, ..., like the field `{clash}`"
                    ),
                ));
            }
        }
    }
    Ok(())
}

"use strict";
// Shows openapi.json: each address with its body, its answers and their fields.

function element(tag, text, ...children) {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}

const nameOf = (reference) => reference.split("/").pop();

function typeOf(schema) {
  if (!schema) return "";
  if (schema.$ref) return nameOf(schema.$ref);
  if (schema.anyOf) return schema.anyOf.map(typeOf).join(" or ");
  if (schema.const !== undefined) return JSON.stringify(schema.const);
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (schema.format === "binary") return "file";
  if (schema.contentEncoding) return schema.contentEncoding;
  if (schema.prefixItems) return `[${schema.prefixItems.map(typeOf).join(", ")}]`;
  if (schema.type === "array") return `list of ${typeOf(schema.items)}`;
  const bounds = [["minimum", "≥"], ["exclusiveMinimum", ">"], ["maximum", "≤"], ["exclusiveMaximum", "<"], ["minLength", "length ≥"], ["maxLength", "length ≤"]];
  return [schema.type ?? "any", ...bounds.filter(([key]) => schema[key] !== undefined).map(([key, sign]) => `${sign} ${schema[key]}`)].join(" ");
}

function fields(schema) {
  const required = new Set(schema.required ?? []);
  const rows = Object.entries(schema.properties ?? {}).map(([name, value]) => {
    const optional = required.has(name) ? "" : value.default !== undefined && value.default !== null && typeof value.default !== "object" ? `, default ${JSON.stringify(value.default)}` : ", optional";
    return element("tr", "", element("th", name), element("td", typeOf(value) + optional), element("td", value.description ?? ""));
  });
  return element("table", "", ...rows);
}

function show(api) {
  const schemas = api.components?.schemas ?? {};
  const resolve = (schema) => (schema?.$ref ? schemas[nameOf(schema.$ref)] : schema);
  document.getElementById("about").textContent = `${api.info.description} Version ${api.info.version}.` + (api.security ? " Every request needs the header Authorization: Bearer TOKEN." : "");
  const articles = [];
  for (const [path, methods] of Object.entries(api.paths)) {
    for (const [method, operation] of Object.entries(methods)) {
      const title = element("h2", "", element("b", method.toUpperCase()), path);
      const article = element("article", "", title, element("p", (operation.description ?? "").replaceAll("`", "")));
      for (const [kind, body] of Object.entries(operation.requestBody?.content ?? {})) {
        article.append(element("h3", kind), fields(resolve(body.schema) ?? {}));
      }
      const answers = Object.entries(operation.responses)
        .map(([status, answer]) => [status, typeOf(answer.content?.["application/json"]?.schema)])
        .filter(([, type]) => type)
        .map(([status, type]) => `${status} ${type}`);
      if (answers.length) article.append(element("h3", `Answers: ${answers.join(", ")}`));
      articles.push(article);
    }
  }
  for (const [name, schema] of Object.entries(schemas)) {
    if (schema.properties) articles.push(element("article", "", element("h2", name), element("p", schema.description ?? ""), fields(schema)));
  }
  document.getElementById("docs").replaceChildren(...articles);
}

fetch("openapi.json").then((answer) => answer.json()).then(show).catch(() => {
  document.getElementById("docs").replaceChildren(element("p", "openapi.json could not be read."));
});
